"""Declarations: a part of a sensor, an effect of a part, and the folder they are found in.

A plugin is one file. It holds a module-level `part` (a Mitsuba plugin with its parameters) or an `effect` (one or a few
parameters of a part that rest at their neutral value, and the function that brings them in). Files are found by
scanning folders, never imported by name, so that what ships has no privilege over what a user writes.

Where an effect enters, in the order that light takes (`STAGES`):

    surface     gel       dz = f(x, y, gel)           mm, added to the gel surface; numpy, (N,) arrays
    spectrum    led       s  = f(spectrum, nm, led)   power per nm, of a function of the wavelength; arithmetic of
                optics.polarization.mueller
    emission    led       k  = f(beam, led)           factor on the radiance that an LED sends to a point; Dr.Jit
    segment     gel       k  = f(path, gel)           factor on the light along its path in the gel; Dr.Jit
    reflection  membrane  fr = f(geometry, membrane)  added to the BRDF, 1/sr; Dr.Jit
    volume      gel       L  = f(path, gel)           radiance added by the gel itself, per LED; Dr.Jit
    ambient     membrane  L  = f(geometry, membrane)  radiance added that no LED made; Dr.Jit
    glow        interface L  = f(glow, interface)     (B,) radiance that a boundary sends to the camera, per light;
                numpy
    index       clear     n  = f(n, wavelengths, clear)  refractive index per band; arithmetic of
                optics.polarization.mueller
    absorption  clear     a  = f(a, wavelengths, clear)  absorption coefficient per band, 1/mm; arithmetic of
                optics.polarization.mueller
    layer       a layer   M  = f(crossing, layer)     Mueller matrix that light passes after the layer's own
                (optics.polarization.layers)
    detector    camera    r  = f(row, camera)         the row (r0, r1, r2, r3) by which the detector weighs S0 ... S3,
                (1, 0, 0, 0) before; numpy
    sensitivity camera    q  = f(q, nm, camera)       sensitivities of the channels, (C, N); numpy
    lens        camera    I  = f(image, camera)       irradiance per band, (H, W, B); numpy
    site        camera    w  = f(weights, camera)     share of S0, S1, S2 that a pixel of a mosaic of analysers
                records, (H, W, 3); numpy
    sensor      camera    I  = f(image, camera)       signal per channel, (H, W, C), 1 = full scale; numpy
    response    camera    m  = f(image, camera)       response per channel, 1 = full scale; numpy

`camera` has the camera's parameters, the geometry of its pixels (optics.light.development), in `time` the scene's
clock, in `settings` all values by key, such as `analyzer.angle`; `site` (H, W) holds the analyser angle of each pixel
of a mosaic, rad. Functions of the stages `lens`, `site` and `sensor` are affine in what they are given, those of
`response` act pixel by pixel. All must be analytic (no abs, max or branches on their complex arguments): their
derivatives are taken by complex step, exact to rounding (Squire & Trapp, SIAM Rev. 40, 110, 1998). An effect without
functions frees parameters that its part has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from functools import cached_property

from optics.scene.parameter import Parameter
from optics.words import key_of

STAGES = {  # stage -> the role of the parts that it belongs to
    "surface": "gel",
    "spectrum": "led",
    "emission": "led",
    "segment": "gel",
    "reflection": "membrane",
    "volume": "gel",
    "ambient": "membrane",
    "glow": "interface",
    "index": "clear",
    "absorption": "clear",
    "layer": "",
    "detector": "camera",
    "sensitivity": "camera",
    "lens": "camera",
    "site": "camera",
    "sensor": "camera",
    "response": "camera",
}
IMAGE_STAGES = ("sensitivity", "lens", "site", "sensor", "response")
LED_BY_LED = frozenset(
    ("spectrum", "emission", "segment", "volume", "reflection", "ambient")
)  # Monte Carlo light passes none
ROLES = {  # of parts: all that the library knows of them; a kind plays the role of its own name unless it says another
    "camera": "images are developed by its gains, response and what it adds; one in a scene",
    "integrator": "renders, and names the bands",
    "gel": "the skin that a press dents: the parameters of a press, its map of displacements, paths of light in it",
    "led": "a light at a point or of a small area with its own image; among dielectric bodies its lobe is that of `mu`",
    "board": "a rigid carrier of LEDs, which sends no light itself",
    "membrane": "a matt coat of the skin",
    "interface": "a flat boundary that is passed without reflections",
    "clear": "the material of a dielectric body (`index`, `absorption`), where light is followed by Monte Carlo",
    "block": "a body that gives way to what presses it",
    "target": "an object in front of the sensor",
}
CATEGORIES = ("bsdf", "emitter", "sensor", "shape", "integrator")


@dataclass(frozen=True)
class Part:
    """A part of a sensor: the name of its Mitsuba plugin, its category, its parameters and its class.

    build   called once per Mitsuba variant, returns the plugin class (a subclass of mi.BSDF, mi.Emitter, ...)
    checks  functions without arguments that raise AssertionError: the closed forms that the part must meet
    mueller of a layer: its Mueller matrix (optics.polarization.layers)
    stokes  of a luminous area: the Stokes vector that it sends; an emitter without one is a point light, which images
            are made of one by one
    role    what it is to the library, to other parts and to effects (ROLES); the kind itself, unless it stands in for
            another kind: a second camera says role="camera", and every effect of cameras whose parameters it has is
            one of its own
    refracts   True of a boundary that camera rays pass, bent by its parameter `index`
    polarizes  True of what makes polarized light of unpolarized light
    random  f(rng) -> {parameter name: value}: plausible values of parameters whose default and `plausible` are not
            enough (optics.scene.checking.draw)
    """

    kind: str
    category: str
    parameters: tuple[Parameter, ...]
    build: Callable[[], type]
    checks: tuple[Callable[[], None], ...] = ()
    doc: str = ""
    file: str = ""
    mueller: Callable | None = None
    stokes: Callable | None = None
    role: str = ""
    refracts: bool = False
    polarizes: bool = False
    random: Callable | None = None

    def __post_init__(self) -> None:
        if not self.role:
            object.__setattr__(self, "role", self.kind)

    @property
    def family(self) -> str:
        """What a setting of the part changes: camera, light, geometry, or '' for none of them."""
        return {"sensor": "camera", "emitter": "light", "shape": "geometry"}.get(self.category, "")


@dataclass(frozen=True)
class Effect:
    """A physical effect: parameters that rest at neutral until somebody adds them.

    name        words, as in a sentence: "lens vignetting"
    part        kind of the part that carries it, or a role that several kinds play
    parameters  new ones (declared here) or names of parameters that the part already has
    stages      stage -> function: where the physics enters, see the module's text; empty: the part itself does it
    field       of a layer's effect: f(layer) -> what its function reads as `layer.field`, made anew whenever the
                layer's
                words, its shape or the skin around it change
    shape       further parameters that the functions use and that stay as they are (a width, an exponent)
    onset       'tangent' (linear at neutral), 'secant' (the derivative at neutral says nothing: a finite step to
                `plausible` is used) or 'both'
    scope       'common' (one value in all frames) or 'frame' (a value per frame)
    per         'kind' (one value shared by all parts of the kind, such as all LEDs) or 'part' (each its own)
    requires    kinds of further parts that a scene must have for the effect to make sense in it
    reads       names of the part's own parameters that the functions read besides: of the kinds that play the part's
                role, those that lack one do not carry the effect
    mixes_pixels  True where it mixes the pixels of an image: point readings cannot have it
    finer       True where its function of the lens acts on parts of pixels, `camera.side` each way: what is narrower
                than a pixel is moved or smeared before the pixel takes its mean
    acts        coordinates that it acts through: radius, height, slope, led, channel, frame, intensity ...
    needs       what a capture set must vary for it to be seen, in words
    seek        where an effect has a place that no derivative leads to: f(model, values, frames) -> {key: value} of
                further parameters that do nothing at neutral, found from the residual before the effect is scored or
                added
    checks      closed forms, as in Part
    random      plausible values, as in Part
    drafted_from  of a draft: what identifies the captures that its numbers were drawn from, words apart by blanks
                (optics.captures.identity). A diagnosis of the same data does not test it
    """

    name: str
    part: str
    parameters: tuple[Parameter | str, ...]
    stages: Mapping[str, Callable] = dataclass_field(default_factory=dict)
    shape: tuple[Parameter, ...] = ()
    onset: str = "tangent"
    scope: str = "common"
    per: str = "kind"
    requires: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    mixes_pixels: bool = False
    finer: bool = False
    acts: tuple[str, ...] = ()
    needs: str = ""
    seek: Callable | None = None
    field: Callable | None = None
    checks: tuple[Callable[[], None], ...] = ()
    random: Callable | None = None
    drafted_from: str = ""
    doc: str = ""
    file: str = ""

    @property
    def at_rest(self) -> tuple[str, ...]:
        """Names of all that must be at neutral for its functions to be the identity: its parameters, and of what shapes
        it that which other effects free."""
        return (*self.parameter_names, *(p.name for p in self.shape if p.neutral is not None))

    @property
    def key(self) -> str:
        """The name as one word, for the command line: 'lens vignetting' -> 'lens-vignetting'."""
        return key_of(self.name)

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        return tuple(p if isinstance(p, str) else p.name for p in self.parameters)
