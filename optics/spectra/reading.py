"""Spectra as users give them: a file, a name, a law, or pairs of numbers.

    leds.csv                       a table beside the scene, or one that ships: comma, semicolon, tab or blanks, a
                                   header or none; its first column is the wavelength
    lamp.spd                       Mitsuba's format: two columns, no header
    400:0.1, 500:0.8, 700:0.2      pairs as in Mitsuba's <spectrum>
    gaussian(530, 35)              peak and full width at half maximum, nm
    blackbody(2856)                Planck's law at a temperature, K
    phosphor(450, 20, 560, 120, 4) a blue die and what its phosphor makes: peaks and widths, and the phosphor's power
                                   per power of the die that leaves
    CIE D65, colour:dark skin      a curve of the colour-science library by its name, of several colour checkers as
                                   "colour:ISO 17321-1/dark skin"

The unit of a column stands in its header: nm, um or A for the wavelength, % for a share in per cent. A wavelength
column without a unit is in nm. An absorption is in 1/mm; a column with the title k is an index of extinction: 4 pi k
over the wavelength. Nothing is guessed: a share above 1, wavelengths that do not ascend, values below 0 and units that
are unknown are errors that say what is allowed."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optics.errors import BadScene, UnknownKey
from optics.files.output import shipped
from optics.spectra.curve import KINDS, VISIBLE, Curve

FILES = (".csv", ".txt", ".tsv", ".spd", ".dat")
LENGTHS = {"nm": 1.0, "um": 1e3, "µm": 1e3, "μm": 1e3, "micrometre": 1e3, "a": 0.1, "å": 0.1, "angstrom": 0.1}
LAWS = {
    "gaussian": ("peak nm, fwhm nm", 2),
    "blackbody": ("temperature K", 1),
    "phosphor": ("die nm, its fwhm nm, phosphor nm, its fwhm nm, phosphor power per die power", 5),
}
LIBRARY = {  # kind of a curve -> tables of the colour-science library that hold such curves
    "power": ("SDS_ILLUMINANTS", "SDS_LIGHT_SOURCES"),
    "transmittance": ("SDS_FILTERS",),
    "reflectance": ("SDS_COLOURCHECKERS",),
}
MICROMETRES = 30.0  # wavelengths of light below this number are no nanometres
ALLOWED = (
    "a file (.csv, .txt, .tsv, .spd), pairs as in '400:0.1, 700:0.9', gaussian(PEAK, FWHM), blackbody(KELVIN), "
    "phosphor(...), 'CIE NAME' or 'colour:NAME'"
)


def read_curve(text: str, kind: str, folders: Sequence[str | Path] = (), where: str = "") -> Curve:
    """The curve that a text gives.

    kind     one of optics.spectra.curve.KINDS: what its values may be
    folders  where files are looked for, before those that ship
    where    what asks for it, for errors: 'led_red.spectrum'

    Raises BadScene, UnknownKey for a name that the colour-science library lacks.
    """
    text = text.strip()
    say = f"{where + ' = ' if where else ''}'{text}'"
    if (law := re.fullmatch(r"(\w+)\s*\(([^()]*)\)", text)) and law[1].lower() in LAWS:
        return _law(law[1].lower(), law[2], kind, say)
    if re.fullmatch(r"(CIE[ _]|colour:).+", text, re.I):
        return _library(re.sub(r"^(CIE[ _]|colour:)\s*", "", text, flags=re.I), kind, where)
    if text.lower().endswith(FILES):
        columns, file = read_table(text, kind, folders, where)
        if len(columns) != 1:
            raise BadScene(f"{say}: {file.name} has {len(columns)} columns of values; allowed: one, beside wavelengths")
        return columns[0]
    if ":" in text:
        pairs = [pair.split(":") for pair in re.split(r"[,\s]+", text) if pair]
        try:
            nm, values = np.array([[float(a), float(b)] for a, b in pairs]).T
        except ValueError:
            raise BadScene(f"{say}: not pairs of numbers; allowed: {ALLOWED}") from None
        return checked(nm, values, kind, text, say)
    raise BadScene(f"{say}: no spectrum; allowed: {ALLOWED}")


def read_channels(text: str, folders: Sequence[str | Path] = (), where: str = "") -> tuple[Curve, ...]:
    """Sensitivities of a camera's channels: the three of a camera of the colour-science library by its name, or the
    columns of a file. Raises UnknownKey, BadScene."""
    if text.strip().lower().endswith(FILES):
        return read_table(text.strip(), "sensitivity", folders, where)[0]
    import colour

    cameras = colour.MSDS_CAMERA_SENSITIVITIES
    if text not in cameras:
        raise UnknownKey(text, ["identity", *cameras], "camera sensitivity", "", "or a file (.csv)")
    data = cameras[text]
    nm = np.asarray(data.wavelengths, float)
    return tuple(
        Curve(nm, np.asarray(data.values[:, c], float), "sensitivity", f"colour-science: {text}") for c in range(3)
    )


def read_table(
    name: str, kind: str, folders: Sequence[str | Path] = (), where: str = ""
) -> tuple[tuple[Curve, ...], Path]:
    """The curves in the columns of a file, which share its wavelengths, and the file."""
    file = find_file(name, folders, where)
    say = f"{where + ' = ' if where else ''}'{name}'"
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise BadScene(
            f"{say}: {file.name} is not text in UTF-8; allowed: a table of text; save it as CSV UTF-8"
        ) from None
    lines = [line for line in text.splitlines() if line.strip()]
    source = "; ".join(line.strip("# ").strip() for line in lines if line.lower().lstrip("# ").startswith("source"))
    lines = [line for line in lines if not line.lstrip().startswith(("#", "%", "//"))]
    if not lines:
        raise BadScene(f"{say}: {file.name} holds no rows; allowed: a wavelength and a value in each row")
    delimiter = next((d for d in (";", "\t", ",") if d in lines[0]), None)
    rows = [[cell.strip().strip('"') for cell in line.split(delimiter)] for line in lines]
    head = [] if _is_number(rows[0][0]) else rows.pop(0)
    if not rows:
        raise BadScene(f"{say}: {file.name} holds a header and no rows; allowed: a wavelength and a value in each row")
    short = next((row for row in rows if len(row) != len(rows[0]) or len(row) < 2), None)
    if short is not None:
        raise BadScene(
            f"{say}: rows of {file.name} differ in length, or have no value, such as '{' '.join(short)}'; allowed: a "
            "wavelength and values, as many in every row, separated in the same way"
        )
    try:
        data = np.array([[float(cell) for cell in row] for row in rows])
    except ValueError:
        bad = next(cell for row in rows for cell in row if not _is_number(cell))
        raise BadScene(f"{say}: '{bad}' in {file.name} is no number; allowed: decimal points, such as 530.5") from None
    scale = _unit(head[0] if head else "", LENGTHS, 1.0, f"{say}: the header '{head[0] if head else ''}'")
    curves = []
    for column in range(1, data.shape[1]):
        title = head[column] if head else ""
        percent = 0.01 if "%" in title or "percent" in title.lower() else 1.0
        values = data[:, column] * percent
        if kind == "absorption" and title.strip().lower() == "k":
            values = values * 4 * np.pi / (data[:, 0] * scale * 1e-6)
        own = f"{file.name}{f' ({title})' if title and data.shape[1] > 2 else ''}{f', {source}' if source else ''}"
        curves.append(checked(data[:, 0] * scale, values, kind, own, say))
    return tuple(curves), file


def find_file(name: str, folders: Sequence[str | Path] = (), where: str = "") -> Path:
    """A file beside the scene, in the present folder, or among the spectra that ship."""
    known = shipped("scenes") / "spectra"
    for folder in (*folders, Path(), known):
        file = Path(folder) / name
        if file.is_file():
            return file
    raise BadScene(
        f"{where + ' = ' if where else ''}'{name}': no such file beside the scene; those that ship: "
        f"{', '.join(sorted(p.name for p in known.glob('*.csv')))}"
    )


def checked(nm: np.ndarray, values: np.ndarray, kind: str, source: str, say: str) -> Curve:
    """A curve whose numbers are what its kind may have; raises BadScene, which starts with `say`."""
    unit, (low, high), _ = KINDS[kind]
    if not (np.isfinite(nm).all() and np.isfinite(values).all()):
        k = int(np.argmin(np.isfinite(nm) & np.isfinite(values)))
        raise BadScene(
            f"{say}: {values[k]:g} at {nm[k]:g} nm is not finite; allowed: a wavelength and a finite value in each "
            "row; leave out what was not measured"
        )
    if len(nm) < 2:
        raise BadScene(f"{say}: {len(nm)} row; allowed: two and more")
    steps = np.diff(nm)
    if np.any(steps <= 0):
        k = int(np.argmax(steps <= 0))
        raise BadScene(
            f"{say}: wavelengths do not ascend: {nm[k]:g} nm, then {nm[k + 1]:g} nm; allowed: ascending ones, each "
            "once; sort the rows"
        )
    if nm[-1] < MICROMETRES:
        raise BadScene(
            f"{say}: wavelengths of {nm[0]:g} to {nm[-1]:g} nm are not light; allowed: nm, or a header that names "
            "another unit, such as 'wavelength (um)'"
        )
    if high == 1.0 and values.max() > 1.0:
        hint = ", which looks like per cent: then write '%' in the column's header" if 2 < values.max() <= 100 else ""
        raise BadScene(f"{say}: a {kind} of {values.max():g}{hint}; allowed: 0 to 1")
    if values.min() < low or values.max() > high:
        k = int(np.argmax((values < low) | (values > high)))
        raise BadScene(
            f"{say}: {values[k]:g} at {nm[k]:g} nm; allowed: a {kind} ({unit}) from {low:g} "
            f"{'up' if np.isinf(high) else f'to {high:g}'}; set values below the noise to 0"
        )
    if kind in ("power", "sensitivity") and not values.any():
        raise BadScene(f"{say}: 0 at every wavelength; allowed: a {kind} that is above 0 somewhere")
    return Curve(np.asarray(nm, float), np.asarray(values, float), kind, source)


def gaussian(nm: np.ndarray, peak: float, fwhm: float) -> np.ndarray:
    """exp(-4 ln 2 ((nm - peak)/fwhm)^2)."""
    shape: np.ndarray = np.exp(-4 * np.log(2) * ((nm - peak) / fwhm) ** 2)
    return shape


def planck(nm: np.ndarray, kelvin: float) -> np.ndarray:
    """Radiance of a black body per nm, over its value at 560 nm."""
    c2 = 1.4387769e7  # nm K (CODATA 2018)
    radiance: np.ndarray = (560.0 / nm) ** 5 * np.expm1(c2 / (560.0 * kelvin)) / np.expm1(c2 / (nm * kelvin))
    return radiance


def _law(name: str, text: str, kind: str, say: str) -> Curve:
    words, count = LAWS[name]
    try:
        numbers = [float(n) for n in re.split(r"[,\s]+", text.strip()) if n]
    except ValueError:
        numbers = []
    if len(numbers) != count or min(numbers) <= 0:
        raise BadScene(f"{say}: allowed: {name}({words}), numbers above 0")
    nm = np.arange(200.0, 1100.5, 0.5)
    if name == "gaussian":
        values = gaussian(nm, *numbers)
    elif name == "blackbody":
        values = planck(nm, *numbers)
    else:
        die, die_fwhm, phosphor, phosphor_fwhm, ratio = numbers
        values = gaussian(nm, die, die_fwhm)
        values = values + ratio * die_fwhm / phosphor_fwhm * gaussian(nm, phosphor, phosphor_fwhm)
    values[values < 1e-12 * values.max()] = 0.0
    return checked(nm, values, kind, f"{name}({text.strip()})", say)


def _library(name: str, kind: str, where: str) -> Curve:
    """A curve of the colour-science library, interpolated to 1 nm as its authors recommend (CIE 167:2005)."""
    import colour

    found: dict[str, Any] = {}
    for table in LIBRARY.get(kind, ()):
        for key, entry in getattr(colour, table).items():
            for patch, data in entry.items() if hasattr(entry, "items") else ((key, entry),):
                found.setdefault(patch, data)  # of colour checkers, the first has the plain name
                found[f"{key}/{patch}"] = data
    if name not in found:
        raise UnknownKey(name, found, f"{kind} of the colour-science library", where)
    data = found[name].copy()
    data.interpolate(colour.SpectralShape(data.shape.start, data.shape.end, 1))
    values = np.asarray(data.values, float)
    if kind in ("transmittance", "reflectance") and values.max() > 1.5:  # the library has some in per cent
        values = values / 100
    say = f"{where + ' = ' if where else ''}'{name}'"
    return checked(np.asarray(data.wavelengths, float), np.maximum(values, 0.0), kind, f"colour-science: {name}", say)


def _unit(title: str, units: dict[str, float], default: float, say: str) -> float:
    """The factor of the unit that stands in brackets, or after a slash, in a column's title."""
    named = re.search(r"[\[(/]\s*([^\])]+?)\s*[\])]?$", title.strip())
    word = named[1].lower() if named else next((u for u in units if re.search(rf"(^|[\s_]){u}$", title.lower())), "")
    if not word:
        return default
    if word not in units:
        raise BadScene(f"{say} names the unit '{word}'; allowed: nm, um, A")
    return units[word]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def overlap(light: Curve, sensitivities: Sequence[Curve], where: str, camera: str) -> None:
    """Refuse a light that no channel of the camera sees; raises BadScene."""
    low = min(c.span[0] for c in sensitivities)
    high = max(c.span[1] for c in sensitivities)
    nm = np.arange(max(light.span[0], low), min(light.span[1], high), 1.0)
    if not nm.size or not any(np.any(c(nm) * light(nm)) for c in sensitivities):
        raise BadScene(
            f"{where}: light of {light.span[0]:g} to {light.span[1]:g} nm ({light.source}), and {camera} sees "
            f"{low:g} to {high:g} nm; allowed: spectra that share wavelengths; is the unit nm?"
        )


__all__ = ["FILES", "VISIBLE", "checked", "overlap", "read_channels", "read_curve", "read_table"]
