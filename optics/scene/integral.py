"""Channels as integrals over the wavelength: which wavelengths are rendered, and what each counts in each channel.

    I_c = exposure gain_c sum_k int S_k(nm) Q_c(nm) P_k(nm) d nm / N
        ~ exposure gain_c sum_b M_cb L_b

with the spectrum S_k of the light k (its integral is 1: `power` is all of its light), the sensitivity Q_c of the
channel behind the camera's filter, and the radiance P_k that the light sends to the camera per unit of its own. N is
the largest of all int S_k Q_c: light of one wavelength gives what a band at that wavelength gives.

fixed bands  L_b is radiance per nm; M_cb = Q_c(nm_b) w_b/N with the weights w_b of the trapezium rule.
auto         Lights have bands of their own: the nodes of Gauss rules for S_k sum_c Q_c, in each range in which
             shares and reflectances hold (EDGES); L_b = P_k(nm_b) and M_cb = int S_k Q_c l_b/N with the
             Lagrange polynomial l_b of the node; a range that only an effect's light reaches has nodes too. What S_k
             and Q_c are, parameters among them, is in M alone: it is exact whatever they are, and so are its
             derivatives. The number of nodes is the smallest with which what is known of the paths (reflectances, the
             probes of `_probes`) has an error below TOLERANCE, and two at least where much of a light is: what an
             effect does to the wavelengths of a line is a slope at first, which one node has at the same place for all
             channels (metameric paint on `digit` by one node: 38 % off, by two .6 %)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from optics.errors import BadScene
from optics.scene import line
from optics.scene.line import EDGES
from optics.scene.mitsuba_parts import is_part
from optics.spectra.bands import FEW, MOST, parse
from optics.spectra.curve import VISIBLE, Curve, grid
from optics.spectra.quadrature import gauss_nodes, lagrange, widths
from optics.spectra.reading import overlap

TOLERANCE = 1e-4  # of a channel's largest integral: a tenth of a grey level in 1000
MUCH = 0.1  # share of a light's signal from which on a range has two nodes: what effects do there is a slope at first
NEGLIGIBLE = 1e-6  # share of a light's signal below which a range has no nodes of its own
TILT = 0.3  # of the probe exp(+-TILT (nm - 540)/100): layers, whose matrices change with the wavelength


def numbers_of(scene, part: str, values: Mapping) -> SimpleNamespace:
    """A part's parameters, as functions of spectra read them."""
    return SimpleNamespace(name=part, **{n: values[f"{part}.{n}"] for n in scene.parts[part].numbers})


def spectrum_of(scene, light: str, values: Mapping, nm: np.ndarray) -> np.ndarray:
    """(N,) power of a light per nm with what effects make of it, its integral 1 over all wavelengths."""
    part, own = scene.parts[light], numbers_of(scene, light, values)
    if "spectrum" not in part.curves and not hasattr(own, "wavelength"):
        return np.full(len(nm), 1 / line.WHITE)
    shape = line.changed(line.of_part(part, own), part.active("spectrum", own), own)
    return np.asarray(shape(nm) / shape.area + 0.0 * nm)


def colour_index(nm: np.ndarray) -> np.ndarray:
    """0, 1 or 2 for the first, second and third band of shares and reflectances at wavelengths."""
    at = np.asarray(nm, float)
    return np.where(at >= EDGES[0], 0, np.where(at >= EDGES[1], 1, 2))


@dataclass(eq=False)
class Group:
    """Lights of one spectrum and the bands that are theirs.

    lights     names of the lights;   glow  name of the pigment that they make shine, '' for their own light
    spectrum   f(values) -> (N,) on the grid, integral 1 of a light's own
    keys       the parameters that it depends on
    seen       its share of the signal of the brightest group
    bands      numbers of its bands;   polynomials  (n, N) Lagrange polynomials of its nodes, each in its own range
    """

    lights: tuple[str, ...]
    glow: str
    spectrum: Callable[[Mapping], np.ndarray]
    keys: tuple[str, ...]
    seen: float = 1.0
    bands: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    polynomials: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))


class Integral:
    """The wavelengths that a scene is rendered at, and the matrix from bands to channels.

    nm       (B,) wavelengths;   auto  whether lights have bands of their own
    colours  (B,) index of the share or reflectance (0, 1, 2) that a band belongs to
    error    of auto bands, the largest error in a channel over the largest integral of its light, those of the ranges
             added up
    """

    def __init__(self, scene, bands: Sequence[float] = (), count: int = 0):
        self.scene, self.camera = scene, scene.camera
        self.auto = not bands
        channels = scene.camera.channels
        if not channels:
            raise BadScene(
                f"{scene.path}: channels as integrals need the sensitivities of '{scene.camera.name}'; allowed: "
                'sensitivity = a camera of colour-science such as "Nikon 5100 (NPL)", or a file (.csv) with a column '
                "for each channel"
            )
        self.grid = grid(span=(min(c.span[0] for c in channels), max(c.span[1] for c in channels)))
        self.step = widths(self.grid)
        self.quantum = self.camera.seen(self.grid)
        self.base = scene.values()
        self._kept: tuple = (None, None)
        contents = self._contents()
        own = [c for c in contents if not c.glow] or contents
        self.unit = max(float((self.quantum * c.spectrum(self.base) * self.step).sum(1).max()) for c in own)
        if not self.unit > 0:
            raise BadScene(
                f"{scene.path}: no light of the scene is seen by '{self.camera.name}'; allowed: a light whose spectrum "
                f"shares wavelengths with the sensitivities ({self.grid[0]:g} to {self.grid[-1]:g} nm)"
            )
        self.error = 0.0
        if self.auto:
            self.groups = self._placed([c for c in contents if c.seen > NEGLIGIBLE], count)
        else:
            self.nm = np.array(bands, float)
            self.groups = []
        self.colours = colour_index(self.nm)
        self.white = self._white()

    # -- lights -------------------------------------------------------------------------------------------------------
    def spectrum(self, light: str, values: Mapping) -> np.ndarray:
        """(N,) power of a light per nm on the grid."""
        return spectrum_of(self.scene, light, values, self.grid)

    def width(self, light: str, values: Mapping):
        """Area of a light's spectrum over its peak, nm."""
        own, part = numbers_of(self.scene, light, values), self.scene.parts[light]
        return line.of_part(part, own).area if "spectrum" in part.curves or hasattr(own, "wavelength") else line.WHITE

    def spectral_keys(self, light: str) -> tuple[str, ...]:
        """The parameters that a light's spectrum depends on."""
        part = self.scene.parts[light]
        line_of_its_own = "spectrum" not in part.curves
        names = [
            n for n, p in part.numbers.items() if line_of_its_own and p.role in ("light wavelength", "light width")
        ]
        for effect in self.scene.registry.at_stage(part.kind, "spectrum"):
            names += effect.at_rest
        return tuple(f"{light}.{n}" for n in dict.fromkeys(names) if n in part.numbers)

    def _contents(self) -> list[Group]:
        """What reaches the camera, without bands yet: the light of lamps, those of one spectrum together, and what each
        pigment makes of the lamps that excite it."""
        scene = self.scene
        alike: dict[Any, list[str]] = {}
        for light, part in scene.lights.items():
            curve = part.curves.get("spectrum")
            alone = curve is None and part.held.get("wavelength", 0.0) > 0
            own = light if alone else (curve.nm.tobytes(), curve.values.tobytes()) if curve is not None else ""
            alike.setdefault(own, []).append(light)
        found = [
            Group(
                tuple(lights),
                "",
                partial(self.spectrum, lights[0]),
                tuple(key for light in lights for key in self.spectral_keys(light)),
            )
            for lights in alike.values()
        ]
        most = max(self._signal(group) for group in found)
        found = [replace(group, seen=self._signal(group) / most if most > 0 else 0.0) for group in found]
        for pigment in pigments_of(scene):
            exciting = exciting_lights(scene, pigment)
            if not exciting:
                continue
            seen_too = [n for g in found for n in g.lights if n in exciting and g.seen > NEGLIGIBLE]
            if seen_too and self.auto:
                raise BadScene(
                    f"{scene.path}: the camera sees the light of {', '.join(seen_too)} itself and what it makes of "
                    f"'{pigment.name}'; auto bands follow one of them; allowed: fixed bands, such as 400:700:5"
                )
            keys = tuple(f"{pigment.name}.{n}" for n in ("emission_peak", "emission_fwhm"))
            found.append(Group(exciting, pigment.name, partial(self.emission, pigment.name), keys))
        return found

    def _signal(self, group: Group) -> float:
        return float((self.quantum * np.real(group.spectrum(self.base)) * self.step).sum())

    def emission(self, pigment: str, values: Mapping) -> np.ndarray:
        """(N,) radiance of a pigment per nm, per photon that it sends."""
        part = self.scene.parts[pigment]
        return part.emission(numbers_of(self.scene, pigment, values), self.grid)

    # -- nodes --------------------------------------------------------------------------------------------------------
    def _placed(self, contents: Sequence[Group], count: int) -> list[Group]:
        """Groups with their nodes; sets `nm` and `error`."""
        groups: list[Group] = []
        nm: list[float] = []
        worst = 0.0
        colours = colour_index(self.grid)
        for group in contents:
            power = np.real(group.spectrum(self.base))
            wide = self._widest(group)
            shares, others = (
                np.array([(p * self.quantum.sum(0) * self.step)[colours == c].sum() for c in range(3)])
                for p in (power, wide)
            )
            least = NEGLIGIBLE * shares.sum()
            kept = [c for c in range(3) if max(shares[c], others[c]) > least]
            nearest = np.array(kept)[np.abs(np.array(kept)[None] - colours[:, None]).argmin(1)]
            largest = (self.quantum * power * self.step).sum(1).max()
            polynomials, start, total = [], len(nm), 0.0
            for c in kept:
                share = self._share(nearest, c)
                inside = share > 0
                own = power if shares[c] > least else wide
                weight = own * self.quantum.sum(0) * self.step * share
                fewest = count or (2 if shares[c] > MUCH * shares.sum() else 1)
                for n in range(fewest, (count or MOST) + 1):
                    nodes = gauss_nodes(self.grid[inside], weight[inside], n)
                    rows = share * lagrange(nodes, self.grid)
                    error = self._error(nodes, rows, share, own) / largest
                    if error <= TOLERANCE / len(kept):
                        break
                total += float(error)
                nm.extend(nodes)
                polynomials.append(rows)
            worst = max(worst, total)
            groups.append(replace(group, bands=np.arange(start, len(nm)), polynomials=np.concatenate(polynomials)))
        self.nm, self.error = np.array(nm), worst
        return groups

    def _widest(self, group: Group) -> np.ndarray:
        """(N,) the largest power per nm that an effect of a plausible size gives a group: where a phosphor's die may
        leak there have to be nodes, as those of another range say nothing of what becomes of its light."""
        found = np.real(group.spectrum(self.base))
        for key in group.keys:
            p = self.scene.parameters[key]
            if p.neutral is not None:
                found = np.maximum(found, np.real(group.spectrum({**self.base, key: p.neutral + p.plausible})))
        return found

    def _share(self, ranges: np.ndarray, number: int) -> np.ndarray:
        """(N,) what each place of the grid counts in a range: the place on a border of two counts half in each, as what
        jumps there needs for an error of second order in the step."""
        found = (ranges == number).astype(float)
        for k in np.flatnonzero(np.isin(self.grid, EDGES)):
            if k:
                found[k] = ((ranges[k] == number) + (ranges[k - 1] == number)) / 2
        return found

    def _error(self, nodes: np.ndarray, rows: np.ndarray, share: np.ndarray, power: np.ndarray) -> float:
        """The largest error of the integrals of the probes over one range, of all channels."""
        density = self.quantum * power * self.step
        worst = 0.0
        for probe in self._probes():
            exact = density @ (share * probe(self.grid))
            found = (density @ rows.T) @ probe(nodes)  # the rows have the share in them
            worst = max(worst, float(np.abs(found - exact).max()))
        return worst

    def _probes(self) -> list[Callable[[np.ndarray], np.ndarray]]:
        """What is known to be on the paths, as functions of the wavelength."""
        found: list[Callable] = []
        for part in self.scene.parts.values():
            if "reflectance" in part.curves:
                found.append(part.curves["reflectance"])
            elif hasattr(part, "reflectance") and (own := texture_over(part.reflectance, self.grid)) is not None:
                found.append(own)
        stock = [shape for shape in self.scene.mitsuba.shapes() if not is_part(shape.bsdf())]
        layers = [p for p in self.scene.parts.values() if p.registry.parts[p.kind].mueller is not None]
        if stock or layers:
            found += [lambda nm, s=s: np.exp(s * TILT * (nm - 540) / 100) for s in (1, -1)]
        return found

    # -- channels -----------------------------------------------------------------------------------------------------
    def bands_of(self, light: str) -> np.ndarray:
        """Numbers of the bands in which a light is rendered."""
        if not self.auto:
            return np.arange(len(self.nm))
        own = [g.bands for g in self.groups if light in g.lights]
        return np.concatenate(own) if own else np.zeros(0, int)

    def lanes(self, light: str, pigment: str = "") -> np.ndarray:
        """(B,) 1 in the bands of a light's own light, or of what a pigment makes of it; 0 in others."""
        found = np.zeros(len(self.nm))
        for group in self.groups:
            if light in group.lights and group.glow == pigment:
                found[group.bands] = 1.0
        return found

    def matrix(self, values: Mapping | None = None, quantum: np.ndarray | None = None) -> np.ndarray:
        """M (C, B); of complex values complex, for derivatives. quantum: (C, N) other sensitivities."""
        values = self.base if values is None else values
        own = self.quantum if quantum is None else quantum
        if not self.auto:
            at = np.stack([np.interp(self.nm, self.grid, np.real(q), left=0.0, right=0.0) for q in own])
            if np.iscomplexobj(own):
                at = at + 1j * np.stack([np.interp(self.nm, self.grid, np.imag(q)) for q in own])
            return at * widths(self.nm) / self.unit
        keys = [k for g in self.groups for k in g.keys]
        swept = [k for k in keys if isinstance(values[k], np.ndarray)]
        if swept:
            raise BadScene(
                f"{self.scene.path}: readings were swept over {', '.join(swept)}, and auto bands take one spectrum for "
                "all readings of a sweep; allowed: fixed bands, such as 400:700:5"
            )
        state = tuple(values[k] for k in keys)
        if quantum is None and self._kept[0] == state:
            return self._kept[1]
        columns = []
        for g in self.groups:
            self._alike(g, values)
            columns.append((own * self.step * g.spectrum(values)) @ g.polynomials.T)
        found = np.concatenate(columns, 1) / self.unit
        if quantum is None:
            self._kept = (state, found)
        return found

    def _alike(self, group: Group, values: Mapping) -> None:
        """Refuse lights that share bands and no longer have one spectrum."""
        if group.glow or len(group.lights) < 2:
            return
        for name in sorted({k.rpartition(".")[2] for k in group.keys}):
            own = {values[f"{light}.{name}"] for light in group.lights if f"{light}.{name}" in values}
            if len(own) > 1:
                raise BadScene(
                    f"{self.scene.path}: {', '.join(group.lights)} share the bands of one spectrum, and '{name}' "
                    f"differs between them ({', '.join(f'{v:g}' for v in sorted(own, key=abs))}); allowed: one value, "
                    "or fixed bands, such as bands = 400:700:5"
                )

    def colour_matrix(self, values: Mapping) -> np.ndarray:
        """(3, B) from bands to CIE 1931 X, Y, Z; white light of radiance 1 has Y = 1."""
        from optics.spectra.colours import matching

        functions = matching(self.grid)
        return self.matrix(values, functions) * self.unit * line.WHITE / float((functions[1] * self.step).sum())

    def _white(self) -> np.ndarray:
        """(B,) radiance per band of white light of radiance 1, for what no lamp sends. Among auto bands those of white
        lamps have it; without any, the bands share it so that every channel gets what it should."""
        if not self.auto:
            return np.full(len(self.nm), 1 / line.WHITE)
        for group in self.groups:
            part = self.scene.parts[group.lights[0]]
            if not group.glow and "spectrum" not in part.curves and not part.held.get("wavelength", 0.0):
                found = np.zeros(len(self.nm))
                found[group.bands] = 1.0
                return found
        from scipy.optimize import nnls

        found, _ = nnls(self.matrix(), (self.quantum * self.step).sum(1) / line.WHITE / self.unit)
        return found

    def describe(self) -> str:
        """The bands in one line."""
        if not self.auto:
            return f"{len(self.nm)} bands from {self.nm.min():g} to {self.nm.max():g} nm"
        each = "; ".join(
            f"{', '.join(g.lights)}{f' on {g.glow}' if g.glow else ''}: "
            f"{', '.join(f'{nm:.1f}' for nm in self.nm[g.bands])} nm"
            for g in self.groups
        )
        return f"{len(self.nm)} bands, estimated error {self.error:.1e} of a channel ({each})"


def texture_over(texture, nm: np.ndarray) -> Curve | None:
    """What a texture of Mitsuba's has in its middle over the wavelength; None where that is the same everywhere."""
    import drjit as dr
    import mitsuba as mi

    si = dr.zeros(mi.SurfaceInteraction3f, len(nm))
    si.uv = mi.Point2f(0.5)
    si.wavelengths = type(si.wavelengths)(mi.Float(nm.astype(np.float32)))
    values = np.broadcast_to(np.array(texture.eval(si, mi.Bool(True))[0], float), len(nm))
    return Curve(nm, values.copy(), "absorption") if np.ptp(values) > 1e-6 * np.abs(values).max() else None


def pigments_of(scene) -> list:
    """The parts of a scene that shine where ultraviolet light meets them."""
    return [p for p in scene.parts.values() if hasattr(p, "fluorescence")]


def exciting_lights(scene, pigment) -> tuple[str, ...]:
    """The LEDs that make a pigment shine: those of a known wavelength, and those whose curve it absorbs."""
    own = SimpleNamespace(**{n: pigment.number(n) for n in pigment.numbers})
    found = []
    for name in scene.leds:
        part = scene.parts[name]
        curve = part.curves.get("spectrum")
        if part.held.get("wavelength", 0.0) > 0 if curve is None else pigment.excited_by(own, curve):
            found.append(name)
    return tuple(found)


def refuse_unseen(scene) -> None:
    """Refuse a light with a curve of its own that the camera's sensitivities do not see, nor any pigment."""
    channels = scene.camera.channels if scene.camera is not None else ()
    for name, part in scene.lights.items() if channels else ():
        curve: Curve | None = part.curves.get("spectrum")
        if curve is not None and not any(name in exciting_lights(scene, p) for p in pigments_of(scene)):
            overlap(curve, channels, f"{name}.spectrum", f"'{scene.camera.name}'")


__all__ = ["FEW", "VISIBLE", "Integral", "colour_index", "parse", "refuse_unseen"]
