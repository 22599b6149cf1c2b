"""What the numbers of a report mean, in a sentence each: shown where the pointer rests on a column's head, and in a
section at the end of the page, where there is no pointer."""

from __future__ import annotations

import html
import re

GLOSSARY = {  # heads of columns and words of the text -> meaning
    "χ²/dof": "sum of squares of (measured - predicted)/noise, over values less fitted parameters: 1 is noise alone.",
    "held out": "of data that no fit has used: a lower error there does not come from fitting more parameters.",
    "misfit": "rms of measured less predicted, relative to the signal, noise included.",
    "noise": "rms of the camera's or detector's own noise: no model can be better.",
    "noise floor": "χ²/dof of a perfect model, 1, and the range in which noise leaves it.",
    "L1": "mean absolute error, divided by the full scale.",
    "PSNR, dB": "20 log10 of full scale over rms error: 6 dB more is half the error.",
    "SSIM": "structural similarity of measured and predicted, 1 for equal ones.",
    "parameters": "how many numbers were fitted.",
    "bias, DN": "mean of measured less predicted.",
    "rms, DN": "root of the mean square of measured less predicted.",
    "σ": "one standard deviation of the noise of a value; noise alone puts 0.27 % of the values beyond 3.",
    "χ² fall predicted": "by how much the sum of squares would fall if this effect alone were added, linearised.",
    "after refit": "by how much it fell when everything was fitted again with the effect.",
    "strength": "the effect's parameter as fitted, ± one standard deviation.",
    "of plausible": "the strength divided by the size that real sensors usually show: far above 1 is hard to believe.",
    "image change": "rms change of the image by the effect, in σ.",
    "explains": "share of the misfit beyond noise that the effect takes away.",
    "visible": "share of what the effect changes that the other parameters cannot imitate.",
    "p, family": "probability that noise alone gives any of the tested effects such a fall.",
    "confused with": "effects that change nearly the same in these data.",
    "χ² fall": "by how much the sum of squares falls with this explanation.",
    "cost of its strengths": "what is subtracted for large or many strengths: they are improbable before any data.",
    "excess left": "what the explanation leaves unexplained, in standard deviations of what noise would leave.",
    "behind the best": "by how much its score, fall less cost, is below that of the best explanation.",
    "needed to rule it out": "how far behind an explanation must be before it counts as ruled out.",
    "p (noise)": "probability that noise alone makes the parts differ so much.",
    "p (clutter)": "the same, with other small effects besides.",
    "h": "how much the strengths of the parts differ, relative to the whole.",
    "pull on prior": "fitted less prior value, in standard deviations of the prior: beyond 3 the two contradict.",
    "moved, sd": "change of a parameter since the step before, in its own standard deviations.",
}


def explained(page: str) -> str:
    """The page with a `title` on each head of a column whose meaning is known."""

    def head(found: re.Match) -> str:
        meaning = GLOSSARY.get(html.unescape(found[2]).strip()) or _stem(found[2])
        if not meaning or "title=" in found[1]:
            return found[0]
        return f'<th{found[1]} title="{html.escape(meaning)}">{found[2]}</th>'

    return re.sub(r"<th([^>]*)>([^<]+)</th>", head, page)


def _stem(title: str) -> str:
    """Of a head with an addition, such as χ²/dof held out, the meaning of what it begins with."""
    known = [term for term in GLOSSARY if title.startswith(term + " ")]
    return " ".join(GLOSSARY[term] for term in (max(known, key=len, default=""),) if term)
