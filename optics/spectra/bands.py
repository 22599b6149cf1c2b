"""Bands as users name them: wavelengths, a range, or auto."""

from __future__ import annotations

from optics.errors import BadScene

SHORTEST, LONGEST = 100.0, 20_000.0  # nm: what is beyond is no light, and mostly another unit
FEW = 4  # bands that one render carries, and that are read at their centres
MOST = 12  # nodes of a light in one range


def parse(text: str, where: str) -> tuple[tuple[float, ...], int | None]:
    """Bands that a text names, nm, and of "auto" and "auto N" the number of nodes (0: as many as it takes), else None.

    Raises BadScene."""
    text = str(text).strip()
    allowed = "allowed: wavelengths in nm such as 610, 540, 460, a range such as 400:700:10, auto, or auto 3"
    if text.split()[:1] == ["auto"]:
        words = text.split()[1:]
        if len(words) > 1 or words and not (words[0].isdigit() and 1 <= int(words[0]) <= MOST):
            raise BadScene(f"{where}: bands = {text!r}; allowed: auto, or auto N with 1 to {MOST} nodes")
        return (), int(words[0]) if words else 0
    try:
        if ":" in text:
            low, high, step = (float(n) for n in text.split(":"))
            count = round((high - low) / step) + 1 if step else 0
            if not (step > 0 and high > low > 0 and count <= 1000):
                raise ValueError
            bands = tuple(low + step * k for k in range(count))
        else:
            bands = tuple(float(w) for w in text.replace(",", " ").split())
    except ValueError:
        raise BadScene(f"{where}: bands = {text!r}; {allowed}") from None
    if len(bands) > FEW and (
        min(bands) <= 0 or len(set(bands)) < len(bands) or sorted(bands) not in (list(bands), list(bands)[::-1])
    ):
        raise BadScene(f"{where}: bands = {text!r}; allowed: more than four bands above 0 nm in one order, each once")
    for nm in bands:
        if nm and not SHORTEST <= nm <= LONGEST:  # 0 stands for no band
            raise BadScene(
                f"{where}: bands = {text!r}: {nm:g} nm; allowed: {SHORTEST:g} to {LONGEST:g} nm; is the unit nm?"
            )
    return bands, None
