"""`SceneModel`: a scene compared with a capture set, frame by frame.

It implements `optics.fit.model.Model`, which documents what a fit and a diagnosis ask of it."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from scipy import ndimage

from optics.captures.capture_set import Captures, Frame, cfa_channel, sweeps, with_lasting_settings
from optics.captures.noise import Noise
from optics.errors import BadScene, UnknownKey
from optics.fit import geometry
from optics.fit.crew import Hands, Job
from optics.fit.known_shape import ALL, KNOWN, REGIONS, known_shape
from optics.fit.model import value_of
from optics.light.development import STEP, Developer, Linear
from optics.light.renderer import Pixels, everywhere
from optics.scene.images import SIDE
from optics.scene.loader import Scene
from optics.scene.parameter import Parameter, Values, Variable

if TYPE_CHECKING:
    from optics.light.monte_carlo import MonteCarloRenderer

CUT_OFF = 3  # readings of 0, and none below, that tell of an instrument that shows no negative numbers
DERIVATIVES = 2e8  # bytes of derivative images that are kept: the refits of a diagnosis begin with those of its scores
KEPT = 4  # points in parameter space, for each frame, at which the variance that settings bring is remembered
MOST = 0.8  # of the pixels, above which all are needed: what differs from press to press costs more than it saves
BESIDE = 2  # px: with a blur of 0.4 px, what is left out beyond changes used values by 1e-5 of the image
FLAT_FIELDS = ("multiplicative", "additive", "none")


class SceneModel:
    """A scene and its captures: predictions, derivative images, masks and coordinates of every frame.

    frames       of the captures; a raw mosaic is repeated in all channels, of which `usable` keeps each pixel's own
    base         values of the scene, overlaid with what the captures set in every frame
    flat_field   how the measured background B of the untouched sensor enters: "multiplicative" (True): what the
                 scene does not explain of it is a gain; "additive": it is light that a press does not change; None: it
                 is not used
    flat         (H, W, C) DN, the background of all frames above black; None where it is not used
    region       what is fitted and judged: "all", or "known", where the shape is known (optics.fit.known_shape)
    """

    def __init__(
        self,
        scene: Scene,
        captures: Captures,
        noise: Noise | None = None,
        flat_field: bool | str | None = True,
        region: str = ALL,
    ):
        from optics.light.monte_carlo import renderer_of

        noise = noise or captures.noise
        if noise is None:
            raise BadScene(
                f"{captures.folder}: no noise model; give [noise] in captures.toml or repeats to estimate it from"
            )
        self.cut_off = False  # whether readings of 0 are limits
        self.cell = 1  # px each way of the camera's image, of which one value here is the mean (optics.study.cells)
        self.assumed_errors: dict[str, float] = {}  # of settings, besides those that the captures state
        # settings whose error is stated, be it none
        self.stated_errors = {*captures.uncertainty, *(key for f in captures.frames for key in f.uncertainty)}
        if captures.table is not None:
            noise = replace(noise, signed=True)  # of point readings, those below 0 are data
            self.cut_off = _cut_off([f.image for f in captures.frames])
            captures = sweeps(captures, scene.parameters, list(scene.lights))
        else:
            captures = with_lasting_settings(captures)
        captures = _with_files(captures, scene)
        self.scene, self.captures, self.noise = scene, captures, noise
        self.mosaic, self.frames = None, captures.frames
        if captures.cfa is not None:
            self.mosaic = cfa_channel(captures.frames[0].image.shape, captures.cfa)[..., None] == np.arange(3)
            self.frames = [replace(f, image=np.repeat(f.image, 3, axis=2)) for f in captures.frames]
        self.renderer = renderer_of(scene)
        self.monte_carlo = (
            self.renderer.monte_carlo
        )  # whether predictions are Monte Carlo estimates, whose error `variance` holds
        self.sparing = False  # whether pixels that no frame of a press uses do without finer samples
        self._needed_kept: dict[int, Pixels | None] = {}
        self._edges_kept: dict[int, np.ndarray] = {}
        self._dialled_kept: OrderedDict[tuple, np.ndarray] = OrderedDict()
        self._derived: OrderedDict[tuple, np.ndarray | None] = OrderedDict()
        # Values at which slopes turn errors of settings into errors of readings; None: the present ones. While a fit
        # moves, slopes that moved with it would change its weights, and it could circle without an end.
        self.weighed_at: Values | None = None
        if captures.mosaic:
            scene.camera.mosaic = captures.mosaic
        if getattr(scene.camera, "mosaic", ()) and captures.cfa is not None:
            raise BadScene(
                f"{captures.folder}: cfa = '{captures.cfa}', but the scene's camera has a mosaic of analysers; "
                "allowed: mosaic in captures.toml, or a scene whose camera has none"
            )
        self.parameters: dict[str, Parameter] = scene.parameters
        self.base = {
            **scene.values(),
            **scene.check(captures.parameters, f"{captures.folder}/captures.toml [parameters]"),
        }
        # a part may say by its words what it takes
        scene.set({k: v for k, v in self.base.items() if self.parameters[k].role in ("regions", "region")})
        for frame in self.frames:
            scene.check(frame.parameters, f"{frame.file or captures.folder}: frame {frame.name}")
        self.recipe: Callable[[], SceneModel] | None = None  # opens the same model in another process
        self.hands = Hands()
        self.presses, self.charge = self._presses(), frozenset(range(len(self.frames)))
        self.companions = self._companions(self.charge)
        # A power that frames set is a drive level: what a calibration finds is the LED's power at drive 1.
        self.driven = set(scene.powers.values()) & {k for f in self.frames for k in (*f.parameters, *f.readings)}
        self.base.update(dict.fromkeys(self.driven, 1.0))
        self.drives = self.driven & {
            k for f in self.frames for k, sd in captures.uncertainty_of(f).items() if np.ndim(sd) == 0
        }
        self.shape = self.frames[0].image.shape
        height, width = self.shape[:2] if captures.table is None else (1, 1)
        if (width, height) != scene.camera.resolution:
            raise BadScene(
                f"{captures.folder}: images of {width} x {height} px, but the scene's camera has "
                f"{scene.camera.resolution[0]} x {scene.camera.resolution[1]} px; load the scene with "
                f"-D width={width} -D height={height}"
            )
        self.developer = Developer(
            scene.camera,
            scene.integrator.bands or (0.0,),
            noise.black_level,
            noise.saturation,
            self.renderer.distances,
        )
        if self.developer.site is not None and self.monte_carlo:
            raise BadScene(
                f"{captures.folder}: a mosaic of analysers before a scene with dielectric bodies, whose light is "
                "followed without its polarization at the camera; allowed: scenes of layers and matt surfaces"
            )
        if self.developer.matrix.shape[0] != self.shape[2]:
            channels, wanted, first = self.shape[2], self.developer.matrix.shape[0], captures.frames[0].file
            raise BadScene(
                f"{captures.folder / 'captures.toml'}: '{first}' has channels: {channels}, the camera of the "
                f"scene '{captures.scene}' has {wanted}; allowed: {wanted}, "
                + (
                    "a column of `values` for each"
                    if captures.table is not None
                    else "or one band, such as `bands = [540]`: a study of a polarization camera is of one colour"
                    if captures.mosaic is not None
                    else 'or one with cfa = "RGGB" (or its like) if it is a raw mosaic; or take a scene whose '
                    "integrator names one band"
                    if channels == 1
                    else "one for each band of the scene's integrator"
                )
            )
        if flat_field not in (True, False, None, *FLAT_FIELDS):
            raise UnknownKey(str(flat_field), FLAT_FIELDS, "flat-field mode")
        self.flat_field = {True: FLAT_FIELDS[0], False: None, "none": None}.get(flat_field, flat_field)
        backgrounds = [captures.flat_field, *(f.flat_field for f in self.frames)]
        if self.flat_field and any(b is not None for b in backgrounds) and scene.gel is None:
            raise BadScene(
                f"{captures.folder}: the set has a background, and the scene no gel that could be at rest in it; "
                "allowed: --flat-field none"
            )
        if region not in REGIONS:
            raise UnknownKey(region, REGIONS, "region")
        if region == KNOWN and (scene.gel is None or captures.table is not None):
            raise BadScene(
                f"{captures.folder}: region = known, but the scene has no gel that something presses; allowed: all"
            )
        self.region, self._known_shapes = region, {}
        self._backgrounds: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self.flat = self._above_black(captures.flat_field)  # a declared nuisance; see `predict`

    def _above_black(self, background: np.ndarray | None) -> np.ndarray | None:
        """A measured background above black, (H, W, C) DN; None where backgrounds are not used."""
        if background is None or not self.flat_field:
            return None
        if id(background) not in self._backgrounds:  # frames may share one
            whole = np.repeat(background, 3, axis=2) if self.mosaic is not None else background
            above = np.maximum(np.asarray(whole, float) - self.noise.black_level, 1e-3)
            self._backgrounds[id(background)] = background, above  # kept alive, so that no other takes its id
        return self._backgrounds[id(background)][1]

    def flat_of(self, index: int) -> np.ndarray | None:
        """The background of a frame above black, (H, W, C) DN: its own, else that of the set; None where it has
        none."""
        own = self._above_black(self.frames[index].flat_field)
        return self.flat if own is None else own

    def imagine(self, frames: Sequence[Frame]) -> SceneModel:
        """The same model, with the same renderer, with further frames: measurements that could be made."""
        twin = copy.copy(self)
        twin.frames = [*self.frames, *frames]
        twin.driven = self.driven | (
            set(self.scene.powers.values()) & {k for f in frames for k in (*f.parameters, *f.readings)}
        )
        twin.base = {**self.base, **dict.fromkeys(twin.driven - self.driven, 1.0)}
        twin.recipe, twin.hands = None, Hands()
        twin.presses, twin.charge = twin._presses(), frozenset(range(len(twin.frames)))
        twin.companions, twin._edges_kept = twin._companions(twin.charge), dict(self._edges_kept)
        twin._needed_kept = {}
        twin._dialled_kept, twin._derived = OrderedDict(), OrderedDict()
        return twin

    # -- values -------------------------------------------------------------------------------------------------------
    def at(self, values: Values, index: int) -> dict[str, Any]:
        """Every parameter's value in a frame: base <- fitted in all frames <- set in this frame <- fitted in this
        frame.

        The power of an LED that frames set is the product of the setting and of the fitted power.
        """
        now: dict[str, Any] = {**self.base, **values.common}
        frame = self.frames[index]
        for key, value in (*frame.parameters.items(), *frame.readings.items()):
            now[key] = value * now[key] if key in self.driven else value
        found = values.frame.get(index, {})
        powers = {k: values.common.get(k, self.base[k]) for k in self.drives & found.keys()}
        now.update(found)
        now.update({k: found[k] * power for k, power in powers.items()})
        return now

    def _acts(self, values: Values, variable: Variable, index: int) -> dict[str, Any]:
        """The keys through which a variable acts in a frame, each with d key / d variable."""
        own: dict[str, Any] = {**self.frames[index].parameters, **self.frames[index].readings}
        found = values.frame.get(index, {})
        own.update({k: found[k] for k in self.drives & found.keys()})
        if variable.frames is not None:
            return {k: values.common.get(k, self.base[k]) if k in self.drives else 1.0 for k in variable.keys}
        return {k: own.get(k, 1.0) for k in variable.keys if k not in own or k in self.driven}

    def _presses(self) -> list[int]:
        """A number for each frame: frames of one press, which share its geometry, have the same."""
        numbers: dict[tuple, int] = {}
        found = []
        for frame in self.frames:
            own = {**self.base, **frame.parameters, **frame.readings}
            key = (frame.group, *(own[k] for k in self.renderer.geometry_keys))
            found.append(numbers.setdefault(key, len(numbers)))
        return found

    def _companions(self, mine: Iterable[int]) -> list[set[str]]:
        """For each frame, the LEDs that are lit in any frame of the same press that this process makes."""
        lit: dict[int, set[str]] = {press: set() for press in self.presses}
        for i in mine:
            own = {**self.base, **self.frames[i].parameters, **self.frames[i].readings}
            lit[self.presses[i]].update(n for n, power in self.scene.powers.items() if np.any(own[power] != 0))
        return [lit[press] for press in self.presses]

    def take_charge(self, frames: frozenset[int]) -> None:
        """Make the images of these frames; other processes make those of others."""
        if frames != self.charge:
            self.charge, self.companions = frames, self._companions(frames)

    def linear_in(self, variable: Variable) -> bool:
        """Whether predictions are linear in a variable together with all others of which this holds: the LEDs'
        powers, but for drive levels and gains, which multiply them."""
        drive = variable.frames is not None and not self.drives.isdisjoint(variable.keys)
        gains = self.scene.power_gains.values()
        return not drive and all(self._is_power(k) and k not in gains for k in variable.keys)

    def _is_power(self, key: str) -> bool:
        return key in self.renderer.power_keys

    def check_variables(self, variables: Sequence[Variable]) -> None:
        for variable in variables:
            for key in variable.keys:
                if key not in self.parameters:
                    raise UnknownKey(key, self.parameters, "parameter", hint="`optics params SCENE` lists them")

    def lit(self, now: Mapping) -> dict[str, np.ndarray]:
        """The lights that are on and their powers per band (B,), or (N, 1, B) of readings."""
        return {n: self.renderer.powers(now, n) for n in self.renderer.lit(now)}

    def set_scene(self, values: Values, index: int) -> None:
        """Put the scene itself into the state of a frame, every light at power 1: what tracers of rays start from."""
        self.renderer.apply(self.at(values, index))

    # -- prediction ---------------------------------------------------------------------------------------------------
    def radiance(self, now: Mapping, index: int = 0, seed: int = 0) -> np.ndarray:
        """(H, W, B): linear image of a frame at these values; of readings (N, 1, B), also where nothing is lit or
        nothing differs between them: all images have one size, sweeps of readings have each their own. Stokes vectors
        (3, H, W, B) for a mosaic of analysers. In parts of pixels where the renderer is asked for them."""
        if self.developer.site is not None:
            return np.stack([self.renderer.radiance(now, seed, component) for component in range(3)])
        image, side = self.renderer.radiance(now, seed), self.renderer.side
        return np.broadcast_to(image, (*(side * n for n in self.frames[index].image.shape[:2]), image.shape[2]))

    def _side(self, now: Mapping) -> int:
        """How many values of a pixel each way the lens wants to act on at these values."""
        return 1 if self.captures.table is not None else self.developer.side(now)

    def _linear(self, now: Mapping, index: int, seed: int, light: Callable | None = None) -> Linear:
        """The camera linearised about the image of a frame; `light`: gives the image in place of `radiance`."""
        light, side = light or self.radiance, self._side(now)

        def parted(side: int = SIDE) -> np.ndarray:
            with self.renderer.splitting(side):
                return light(now, index, seed)

        whole = side == 1 and self.captures.table is None and not self.monte_carlo
        return self.developer.linearise(parted(side), now, parted if whole else None)

    def intensity(self, now: Mapping, index: int = 0, seed: int = 0) -> np.ndarray:
        """(H, W) radiance that a pixel sees, behind its analyser where it has one; mean of the bands."""
        image = self.radiance(now, index, seed)
        if self.developer.site is not None:
            image = self.developer.behind_analysers(image, self.developer.view(now))
        return image.mean(-1)

    def untouched(self, now: Mapping) -> dict:
        """The same frame with the gel at rest. What does nothing there is put back to where it began, so that it is the
        same gel for all presses and whatever they are like."""
        gel = self.scene.gel.name
        keys = (self.scene.key(gel, role) for role in ("press x", "press y", "press depth"))
        same = {key: value for key, value in self.base.items() if self._rests(key)}
        return {**now, **same, **dict.fromkeys((key for key in keys if key), 0.0)}

    def _at_rest(self, untouched: Mapping, index: int, seed: int) -> np.ndarray:
        """`radiance` of the untouched gel, which all presses share."""
        with everywhere(self.renderer):
            return self.radiance(untouched, index, seed)

    def _rests(self, key: str) -> bool:
        """Whether a parameter does nothing while the gel is untouched."""
        name, _, parameter = key.rpartition(".")
        if name != self.scene.gel.name:
            return False
        own = self.scene.parameters.get(key)
        return parameter in getattr(self.scene.gel, "pressing", ()) or (own is not None and own.when_pressed)

    def predict(self, values: Values, frames: Sequence[int] | None = None, seed: int = 0) -> list[np.ndarray]:
        """Noise-free DN (H, W, C) of each frame.

        With a flat field B (the measured background of the untouched sensor), P0 the prediction for the gel at rest in
        the same frame, and the frame's gain g per channel:
            multiplicative   black + g (B - black) (P - black)/(P0 - black)
            additive         black + g (B - black) + P - P0             (light adds up: exact for a linear response)
        """
        return list(self._made(frames, _predicted, values=values, seed=seed))

    def _made(self, frames: Sequence[int] | None, make: Callable, **given: Any) -> Iterator[Any]:
        """What `make` makes of the model and each frame, in this process or in another that has the same model."""
        return self.hands.work(self, self._indices(frames), partial(make, sparing=self.sparing, **given))

    def each(self, frames: Sequence[int], jobs: Sequence[Job]) -> Iterator[tuple[int, Any]]:
        """(number, what it makes) of each job, a function of the model that asks for images of these frames, as they
        are done; several at once where processes are allowed and would not share the frames."""
        return self.hands.each(self, frames, [partial(_made_by, sparing=self.sparing, job=job) for job in jobs])

    def turn_to(self, values: Values, index: int) -> dict:
        """A frame's values; tells the renderer which other LEDs will be asked for in the same geometry, and of which
        pixels."""
        self.renderer.together = self.companions[index]
        self.renderer.wanted = self._needed(index) if self.sparing else None
        return self.at(values, index)

    @contextmanager
    def where_used(self) -> Iterator[None]:
        """Within it, predictions are exact only at pixels that a frame of the same press uses, and beside them. Few
        camera rays and few directions of second reflections serve the rest, and no finer samples. A lens brings light
        from there too: beside a dent of `gelsight` this changed the derivative of veiling glare by 0.3 %."""
        before, self.sparing = self.sparing, True
        try:
            yield
        finally:
            self.sparing, self.renderer.wanted = before, None

    def _needed(self, index: int) -> Pixels | None:
        """Pixels that frames of the same press use, and those within BESIDE of them; None: MOST or all. One object for
        all frames of a press, as they share its images.

        A lens that shifts by more than BESIDE brings the value of a pixel's middle to the edge of a mask."""
        if index not in self._needed_kept:
            press = [i for i, own in enumerate(self.presses) if own == self.presses[index]]
            needed: Pixels | None = None
            if self.captures.table is None and not (self.renderer.layered or self.renderer.crowded):
                self.renderer.wanted = None  # masks may look at images themselves
                used = np.any([self.usable(i).any(-1) for i in press], axis=0)
                near = ndimage.binary_dilation(used, np.ones((2 * BESIDE + 1, 2 * BESIDE + 1), bool))
                needed = None if near.mean() > MOST else Pixels(near)
            self._needed_kept.update(dict.fromkeys(press, needed))
        return self._needed_kept[index]

    def _develop(self, now: Mapping, index: int, seed: int, light: Callable | None = None) -> np.ndarray:
        with self.renderer.splitting(self._side(now)):
            return self.developer.develop((light or self.radiance)(now, index, seed), now)

    def _predict(self, now: Mapping, index: int, seed: int = 0) -> np.ndarray:
        image = self._develop(now, index, seed)
        background = self.flat_of(index)
        if background is None:
            return image
        black = self.noise.black_level
        flat = background * self.gains(now)
        at_rest = self.untouched(now)
        rest = self._develop(at_rest, index, seed, self._at_rest)
        if self.flat_field == "additive":
            return black + flat + image - rest
        return black + (image - black) * flat / np.maximum(rest - black, 1e-6)

    def gains(self, now: Mapping) -> np.ndarray:
        """(C,) gain of a frame by which its background is scaled."""
        return self.developer.gains(self.developer.view(now))

    def background_share(self, values: Values | None = None, index: int = 0) -> list[dict[str, float]]:
        """How much of the flat field's structure the scene explains by itself, per channel.

        structure   DN, rms of the flat field about its mean; left: DN, rms of it less the predicted background
        share       1 - (left/structure)^2
        What is left enters predictions as a gain or as light (`flat_field`); either way it is not explained.
        """
        background = self.flat_of(index)
        if background is None:
            raise BadScene(f"{self.captures.folder}: no flat field in use")
        rest = self._develop(self.untouched(self.at(values or Values(), index)), index, 0) - self.noise.black_level
        found = []
        for c in range(self.shape[2]):
            structure, left = np.std(background[..., c]), np.sqrt(np.mean((background - rest)[..., c] ** 2))
            found.append(
                {"structure": float(structure), "left": float(left), "share": float(1 - (left / structure) ** 2)}
            )
        return found

    def _indices(self, frames) -> list[int]:
        return list(range(len(self.frames))) if frames is None else list(frames)

    def derivatives(
        self,
        values: Values,
        variables: Sequence[Variable],
        frames: Sequence[int] | None = None,
        secant: Mapping[str, float] | None = None,
        seed: int = 0,
    ) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Per frame: prediction (H, W, C) in DN and {variable's name: d prediction / d value}, float32.

        `secant` gives, by name, a finite step to take from the present value in place of the tangent. Variables that do
        nothing in a frame are left out of its dictionary. Of another seed than the predictions', images of light
        reflected twice are made of fewer samples where the model has none yet."""
        self.check_variables(variables)
        yield from self._made(
            frames, _differentiated, values=values, variables=variables, secant=secant or {}, seed=seed
        )

    def _differentiate(
        self, values: Values, variables: Sequence[Variable], secant: Mapping[str, float], seed: int, index: int
    ):
        now = self.turn_to(values, index)
        black = self.noise.black_level
        linear = self._linear(now, index, seed)
        prediction = linear.image
        background = self.flat_of(index)
        if background is not None:
            at_rest = self.untouched(now)
            rest = self._linear(at_rest, index, seed, self._at_rest)
            flat = background * self.gains(now)
            if self.flat_field == "additive":
                prediction, scale, share, gained = black + flat + linear.image - rest.image, 1.0, 1.0, 1.0
            else:
                level = np.maximum(rest.image - black, 1e-6)
                scale, share = flat / level, (linear.image - black) / level
                prediction, gained = black + (linear.image - black) * scale, share
        images: dict[str, np.ndarray] = {}
        at_once = self._light_at_once(values, now, variables, secant, index, seed)
        at = self._place_of(now, index)
        # the tangents at rest come after all others, so that the gel is brought there once
        waiting: list[tuple[Variable, dict[str, Any], tuple | None, np.ndarray | None]] = []
        for variable in variables:
            acts = self._acts(values, variable, index)
            if not acts:
                continue
            # 0 where no seed matters, so that a second one finds the image of the first
            own_seed = seed if self._depends_on_seed(now, acts) else 0
            key = None if at is None else (own_seed, secant.get(variable.name), variable.frames, *acts.items(), *at)
            image: Any
            if key in self._derived:
                self._derived.move_to_end(key)
                image = self._derived[key]
            elif variable.name in secant:
                image = self._secant(values, variable, index, secant[variable.name], prediction, seed, at_once)
            elif variable.name in at_once:
                image = linear.of_image(at_once[variable.name])
                if camera := self._shown_by_camera(acts):
                    image = image + linear.of_parameter(camera)
            else:
                with self.renderer.splitting(self._side(now)):
                    image = self._tangent(linear, now, acts, seed)
                if background is not None:
                    waiting.append((variable, acts, key, image))
                    images[variable.name] = np.empty(0)  # holds its place
                    continue
            self._hold(images, variable.name, key, image, index)
        for variable, acts, key, image in waiting:
            own = {k: f for k, f in acts.items() if not self._rests(k)}
            with everywhere(self.renderer), self.renderer.splitting(self._side(at_rest)):
                still = self._tangent(rest, at_rest, own, seed, True)
            if image is not None or still is not None:
                image = scale * ((0 if image is None else image) - share * (0 if still is None else still))
                if any(self.parameters[k].how == "image" for k in acts):
                    stepped = {**now, **{k: now[k] + 1j * STEP for k in acts}}
                    image = image + gained * background * (self.gains(stepped).imag / STEP)
            self._hold(images, variable.name, key, image, index)
        return prediction, images

    def _hold(
        self, images: dict[str, np.ndarray], name: str, key: tuple | None, image: np.ndarray | None, index: int
    ) -> None:
        """Put a derivative image among those of its frame; None: the frame has none of it."""
        if image is not None:
            image = image.astype(np.float32, copy=False)
            images[name] = np.broadcast_to(image, self.frames[index].image.shape)
        else:
            images.pop(name, None)
        if key is not None:
            self._keep_derived(key, image)

    def _place_of(self, now: Mapping, index: int) -> tuple | None:
        """What a derivative image of a frame depends on besides its variable and the seed; None: images of readings are
        not kept."""
        if self.captures.table is not None:
            return None
        crowds = self.renderer.geometry(now) if self.renderer.crowded else ()  # bodies may have been put elsewhere
        return index, self.renderer.wanted, *crowds, *sorted(now.items())

    def _depends_on_seed(self, now: Mapping, keys: Iterable[str]) -> bool:
        """Whether the derivative image by these keys is another for another seed."""
        second = self.renderer.bounce_key
        return self.monte_carlo or bool(second and (now[second] or second in keys))

    def _keep_derived(self, key: tuple, image: np.ndarray | None) -> None:
        """Keep a derivative image; None where nothing depends on the variable."""
        self._derived[key] = image
        size = max(self.frames[0].image.size * np.dtype(np.float32).itemsize, 1)
        while len(self._derived) > max(DERIVATIVES / size, 1):
            self._derived.popitem(last=False)

    def _secant(
        self,
        values: Values,
        variable: Variable,
        index: int,
        step: float,
        prediction: np.ndarray,
        seed: int,
        at_once: Mapping[str, np.ndarray] = MappingProxyType({}),
    ) -> np.ndarray:
        """[f(value + step) - f(value)] / step of the whole prediction; at a bound, the step goes the other way.

        at_once   linear images with the steps, of variables for which they are known
        """
        moved, step = self._stepped(values, variable, step)
        now = self.at(moved, index)
        if variable.name in at_once:
            return (self.developer.develop(at_once[variable.name], now) - prediction) / step
        with self.renderer.in_passing():
            return (self._predict(now, index, seed) - prediction) / step

    def _stepped(self, values: Values, variable: Variable, step: float) -> tuple[Values, float]:
        """(values with a step of a variable, the step); at a bound it goes the other way."""
        value = value_of(self, values, variable)
        if not variable.parameter.bounds[0] <= value + step <= variable.parameter.bounds[1]:
            step = -step
        moved = values.copy()
        moved.put(variable, value + step)
        return moved, step

    def _light_at_once(
        self,
        values: Values,
        now: Mapping,
        variables: Sequence[Variable],
        secant: Mapping[str, float],
        index: int,
        seed: int,
    ) -> dict[str, np.ndarray]:
        """Of readings, name -> (N, 1, B): d radiance / d value, or the radiance with the step of a secant, of all
        variables that act in layers alone: their readings are predicted one behind the other, as one long sweep."""
        if self.captures.table is None or not (self.lit(now) or self.renderer.glows(now)):
            return {}
        found: dict[str, np.ndarray] = {}
        for stepped in (False, True):
            own, states = [], []
            for v in variables:
                acts = self._acts(values, v, index)
                alike = all(self.parameters[k].how == "layer" and self.parameters[k].role != "face" for k in acts)
                if not acts or not alike or (v.name in secant) != stepped:
                    continue
                own.append(v)
                if stepped:
                    states.append(self.at(self._stepped(values, v, secant[v.name])[0], index))
                else:
                    states.append({**now, **{k: now[k] + 1j * STEP * factor for k, factor in acts.items()}})
            if len(own) < 2:
                continue
            radiance = self.renderer.radiance(_behind(now, states), seed)
            parts = np.split(radiance, len(own))
            shape = (*self.frames[index].image.shape[:2], radiance.shape[2])
            found.update({v.name: np.broadcast_to(p if stepped else p.imag / STEP, shape) for v, p in zip(own, parts)})
        return found

    def _tangent(
        self, linear, now: Mapping, acts: Mapping[str, float], seed: int, at_rest: bool = False
    ) -> np.ndarray | None:
        """d DN / d value in a frame for keys that share one value; None where nothing depends on them."""
        camera, light = self._shown_by_camera(acts), None
        for key, factor in acts.items():
            if self.parameters[key].how == "image":
                continue
            change = self._light_tangent(now, key, factor, seed, at_rest)
            if change is not None:
                light = change if light is None else light + change
        total = None if light is None else linear.of_image(light)
        if camera:
            total = linear.of_parameter(camera) + (0 if total is None else total)
        return total

    def _shown_by_camera(self, keys: Iterable[str]) -> tuple[str, ...]:
        """Those that act in the camera: its own parameters of images, and the clock by which its dark signal drifts."""
        return tuple(k for k in keys if self.parameters[k].how == "image" or k == self.developer.camera.clock)

    def _light_tangent(self, now: Mapping, key: str, factor: Any, seed: int, at_rest: bool) -> np.ndarray | None:
        """factor times d radiance / d key in a frame; of Stokes vectors, as `radiance` has them."""
        if self.developer.site is None:
            return self._component_tangent(now, key, factor, seed, at_rest, 0)
        parts = [self._component_tangent(now, key, factor, seed, at_rest, component) for component in range(3)]
        return None if parts[0] is None else np.stack(cast("list[np.ndarray]", parts))

    def _component_tangent(
        self, now: Mapping, key: str, factor: Any, seed: int, at_rest: bool, component: int
    ) -> np.ndarray | None:
        """factor times d / d key of one component of the Stokes vectors at the camera."""
        name = key.rsplit(".", 1)[0]
        own = name in self.scene.leds  # a parameter of one point light
        lit = self.lit(now)
        tangent = self.renderer.led_tangent_at_rest if at_rest else self.renderer.led_tangent
        glows = self.renderer.glows(now)
        if not lit and not glows and key not in self.renderer.ambient_keys and self.parameters[key].how != "difference":
            return None  # a dark frame
        if self.parameters[key].how == "layer":
            return factor * (
                np.imag(self.renderer.radiance({**now, key: now[key] + 1j * STEP}, seed, component)) / STEP
            )
        if key == self.renderer.bounce_key:
            if not lit:
                return None
            # of light that the model does not have yet, a ranking needs but a rough image, twice
            rough = seed != 0 and not now[key]
            return factor * sum(
                power * self.renderer.bounced(now, led, seed, component, rough) for led, power in lit.items()
            )
        if self._is_power(key):
            if np.all(factor == 0):
                return None
            # the power is a product: the derivative by one factor is the product of the others
            others = self.renderer.powers({**now, key: 1.0}, name)
            if key in self.scene.band_powers[name]:
                band = self.scene.band_powers[name].index(key)
                others = np.where(self.renderer.colours == band, others, 0.0)
            factor = factor * others
            if not np.any(factor):
                return None
            return factor * self.renderer.light(
                {**now, **dict.fromkeys(self.scene.power_keys(name), 1.0)}, name, seed, component
            )
        if own and name not in lit:
            return None
        if self.renderer.monte_carlo:
            return factor * cast("MonteCarloRenderer", self.renderer).tangent(now, key, seed)
        if key in self.renderer.ambient_keys:
            return factor * self._difference_ambient(now, key, component)
        if self.parameters[key].how == "difference" and not own:
            return factor * self._difference(now, key, seed, component)
        if own:
            image = (
                self._difference_led(now, name, key, component)
                if self.parameters[key].how == "difference"
                else tangent(now, name, key, component)
            )
            return factor * (lit[name] * image + self._difference_bounced(now, {name: lit[name]}, key, seed, component))
        total: Any = sum((power * tangent(now, led, key, component) for led, power in lit.items()), 0.0)
        total = total + self._difference_bounced(now, lit, key, seed, component)
        if glows:
            total = total + self._difference_ambient(now, key, component)
        return factor * total

    def _difference_bounced(
        self, now: Mapping, lit: Mapping[str, np.ndarray], key: str, seed: int, component: int
    ) -> np.ndarray | float:
        """d / d key of what lights send by way of two reflections: a difference with the same second directions."""
        weight = now[self.renderer.bounce_key] if self.renderer.bounce_key else 0.0
        if not weight:
            return 0.0
        low, high = self.parameters[key].sides(now[key])
        bounced = self.renderer.bounced
        ends = [
            sum(power * bounced({**now, key: value}, led, seed, component, roughly=True) for led, power in lit.items())
            for value in (low, high)
        ]
        return weight * (ends[1] - ends[0]) / (high - low)

    def _difference(self, now: Mapping, key: str, seed: int, component: int) -> np.ndarray:
        """Central difference of the linear image, one-sided at a bound; common samples."""
        low, high = self.parameters[key].sides(now[key])
        with self.renderer.in_passing(roughly=True):
            first, second = (self.renderer.radiance({**now, key: value}, seed, component) for value in (low, high))
        return (second - first) / (high - low)

    def _difference_led(self, now: Mapping, led: str, key: str, component: int) -> np.ndarray:
        """Central difference of one LED's image by a parameter of its own. The same parameter of other LEDs, which does
        not show in this image, is moved too where their derivatives are asked for: so all are made at once."""
        number = key.rpartition(".")[2]
        mates = {f"{other}.{number}" for other in self.renderer.together} & self.renderer.asked
        sides = {k: self.parameters[k].sides(now[k]) for k in {key} | mates}
        with self.renderer.in_passing():
            first, second = (
                self.renderer.image({**now, **{k: ends[n] for k, ends in sides.items()}}, led, component)
                for n in (0, 1)
            )
        low, high = sides[key]
        return (second - first) / (high - low)

    def _difference_ambient(self, now: Mapping, key: str, component: int) -> np.ndarray:
        low, high = self.parameters[key].sides(now[key])
        first, second = (self.renderer.ambient({**now, key: value}, component) for value in (low, high))
        return (second - first) / (high - low)

    # -- what a fit and a diagnosis need of the data ------------------------------------------------------------------
    def usable(self, index: int) -> np.ndarray:
        """(H, W, C) bool, the values to use: not saturated, not clipped at black, not masked by the user, in a mosaic
        the pixel's own channel; in the model's region."""
        return self.usable_in(index, self.region)

    def usable_in(self, index: int, region: str) -> np.ndarray:
        """`usable` of another region (optics.fit.known_shape)."""
        frame = self.frames[index]
        beside = 1 if self.captures.table is None else 0  # readings of a sweep are no neighbours
        mask = self.noise.usable(frame.image, beside)
        mask = np.broadcast_to(mask if mask.ndim == 3 else mask[..., None], frame.image.shape).copy()
        if frame.mask is not None:
            mask &= np.asarray(frame.mask, bool)[..., None]
        if self.mosaic is not None:
            mask &= self.mosaic
        if self.cut_off:
            mask &= frame.image != 0
        if self.renderer.layered and self.captures.table is None:
            mask &= self._resolved(index)
        if region == KNOWN:
            mask &= self._known_shape(index)[..., None]
        return mask

    def _known_shape(self, index: int) -> np.ndarray:
        if index not in self._known_shapes:
            self._known_shapes[index] = known_shape(self, index)
        return self._known_shapes[index]

    def _resolved(self, index: int) -> np.ndarray:
        """(H, W, C) False at sharp edges that the finer samples do not resolve to the noise: where the step across a
        pixel, over the number of samples, exceeds a sixth of the noise. At the base's values, so that no fit changes
        it."""
        if index not in self._edges_kept:
            now = self.at(Values(), index)
            across: Any = 0.0  # the step, of Stokes vectors the sum of the steps of three components: an upper bound
            images = [(self.renderer.led(now, light), power) for light, power in self.lit(now).items()]
            if self.renderer.glows(now):
                images.append((self.renderer.glow(now), np.ones(1)))
            for image, power in images:
                if image.raw is None or not len(image.index):
                    continue
                for component in range(1 if self.developer.site is None else 3):
                    fine = image.raw[1] * self.renderer.weights(now, image, component)[1]
                    across = across + power * image.finer.span(fine)
            known = np.ones(self.shape, bool)
            if np.ndim(across):
                view = self.developer.view(now)
                full = self.noise.saturation - self.noise.black_level
                step = (across @ self.developer.matrix.T) * np.abs(self.developer.scale(view)) * full
                level = self.predict(Values(), [index])[0].reshape(-1, self.shape[2])[image.index]
                known.reshape(-1, self.shape[2])[image.index] = (
                    step / self.renderer.rim_samples < self.noise.sd(level) / 6
                )
            self._edges_kept[index] = known
        return self._edges_kept[index]

    @property
    def size(self) -> float:
        """Values that a frame holds (on average, of readings): pixels x channels, or the pixels of a mosaic."""
        return float(np.mean([f.image.size for f in self.frames])) / (3 if self.mosaic is not None else 1)

    def variance(self, values: Values, index: int, prediction: np.ndarray) -> np.ndarray:
        """(H, W, C) in DN^2, of a frame about its prediction: the camera's noise; where images are Monte Carlo
        estimates, their own error, averaged over 3 x 3 pixels as it is itself known to a quarter only; and of readings,
        (d prediction / d setting x sd)^2 for every setting with an uncertainty (`capture_set.sweeps`)."""
        noise = self.noise.variance(prediction)
        if self.monte_carlo:
            noise = noise + self.error_of_estimate(values, index)
        if self._dialled(index):
            noise = noise + self._of_settings(values, index)
        return noise

    @property
    def dialled(self) -> bool:
        """Whether readings have settings with an error of their own."""
        return any(self._dialled(i) for i in range(len(self.frames)))

    def _dialled(self, index: int) -> dict[str, np.ndarray]:
        """The settings of a sweep whose errors differ from reading to reading: (N, 1, 1) standard deviations by key."""
        return {k: sd for k, sd in self.frames[index].uncertainty.items() if isinstance(sd, np.ndarray) and sd.any()}

    def errors_of_settings(self, values: Values, index: int) -> dict[str, np.ndarray]:
        """key -> (N, 1, C) standard deviation in DN of the readings of a sweep, signed as their slopes, by the errors
        of a setting that differ from reading to reading; at the values or at `weighed_at`."""
        values, errors = self.weighed_at or values, self._dialled(index)
        # of a drive level, the power that it multiplies
        factors = {key: {**self.base, **values.common}[key] if key in self.driven else 1.0 for key in errors}
        return {key: slope * errors[key] for key, slope in self.slopes(values, index, factors).items()}

    def _of_settings(self, values: Values, index: int) -> np.ndarray:
        """(N, 1, C) variance in DN^2 that these bring, to second order: (I' s)^2 + 3/4 (I'' s^2)^2, the mean square of
        I' e + I'' e^2/2. Where a dial stands at an extinction the slope vanishes, and its error still brings light."""
        values = self.weighed_at or values
        own = values.frame.get(index, {})
        state = (index, *sorted(values.common.items()), None, *sorted(own.items()))
        if state not in self._dialled_kept:
            first = self.errors_of_settings(values, index).values()
            self._dialled_kept[state] = sum((error**2 for error in first), self._bent(values, index))
            while len(self._dialled_kept) > KEPT * len(self.frames):
                self._dialled_kept.popitem(last=False)
        return self._dialled_kept[state]

    def _bent(self, values: Values, index: int) -> np.ndarray:
        """The second order of `_of_settings`, by finite differences of one standard deviation."""
        now, frame = self.turn_to(values, index), self.frames[index]
        total = np.zeros((1, 1, 1))
        for key, weighed in self._dialled(index).items():
            if key in self.driven:
                continue  # readings are linear in a drive level
            _, place, count = np.unique(frame.made[key], return_inverse=True, return_counts=True)
            together = count[place].reshape(weighed.shape)
            sd = weighed / np.sqrt(together)
            up, there, down = (self._predict({**now, key: now[key] + step * sd}, index) for step in (1, 0, -1))
            total = total + 0.75 * together * (up - 2 * there + down) ** 2
        return total

    def slopes(self, values: Values, index: int, factors: Mapping[str, float]) -> dict[str, np.ndarray]:
        """key -> factor d prediction / d setting in a frame, (N, 1, C) DN per unit; without those that change
        nothing."""
        now = self.turn_to(values, index)
        linear = self._linear(now, index, 0)
        found = {key: self._tangent(linear, now, {key: factor}, 0) for key, factor in factors.items()}
        return {key: slope for key, slope in found.items() if slope is not None}

    def error_of_estimate(self, values: Values, index: int) -> np.ndarray:
        """(H, W, C) variance of a Monte Carlo prediction, DN^2."""
        from scipy.ndimage import uniform_filter

        now = self.at(values, index)
        view = self.developer.view(now)
        full = (self.noise.saturation - self.noise.black_level) * np.abs(self.developer.scale(view))
        error = cast("MonteCarloRenderer", self.renderer).error(now)
        return uniform_filter((error**2 @ (self.developer.matrix**2).T) * full**2, (3, 3, 0), mode="nearest")

    def chance(self, index: int = 0) -> float:
        """Error of the prediction itself over the camera's noise in a frame, rms; 0 where images are exact."""
        if not self.monte_carlo:
            return 0.0
        prediction = self.predict(Values(), [index])[0]
        return float(np.sqrt(np.mean(self.error_of_estimate(Values(), index) / self.noise.variance(prediction))))

    def coordinates(self, values: Values, index: int, seed: int = 0) -> dict[str, np.ndarray]:
        return geometry.coordinates(self, values, index, seed)

    def lit_geometry(self, values: Values, index: int) -> dict[str, np.ndarray]:
        return geometry.lit_geometry(self, values, index)

    def wavelengths(self) -> list[float]:
        """Mean wavelength of each channel, nm; 0 where the scene names no bands."""
        bands, matrix = self.developer.bands, self.developer.matrix
        if not any(bands):
            return [0.0] * self.shape[2]
        return list(matrix @ np.array(bands) / matrix.sum(1))

    def family(self, key: str) -> str:
        if key in self.parameters and self.parameters[key].role == "clock":
            return "time"
        if key == "site":
            return "camera"
        name = key.rpartition(".")[0]
        return self.scene.declaration(name).family if name in self.scene.parts else ""


def _made_by(model: SceneModel, sparing: bool, job: Job) -> Any:
    model.sparing = sparing
    return job(model)


def _predicted(model: SceneModel, index: int, sparing: bool, values: Values, seed: int) -> np.ndarray:
    model.sparing = sparing
    return model._predict(model.turn_to(values, index), index, seed)


def _differentiated(
    model: SceneModel,
    index: int,
    sparing: bool,
    values: Values,
    variables: Sequence[Variable],
    secant: Mapping[str, float],
    seed: int,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    model.sparing = sparing
    own = [v for v in variables if v.holds_in(index)]
    tangents = {
        k
        for v in own
        if v.name not in secant
        for k in model._acts(values, v, index)
        if model.parameters[k].how == "ad"
        and not model._is_power(k)
        or model.parameters[k].how == "difference"
        and k.rpartition(".")[0] in model.scene.leds
    }
    with model.renderer.asking(tangents):
        return model._differentiate(values, own, secant, seed, index)


def _behind(now: Mapping, states: Sequence[Mapping]) -> dict[str, Any]:
    """Values of one sweep that holds those of several, one behind the other; what never differs stays as it is."""
    arrays = {key for key, value in now.items() if isinstance(value, np.ndarray)}
    count = max([now[key].size for key in arrays], default=1)
    joined = dict(now)
    for key, value in now.items():
        if key not in arrays and all(state[key] is value or state[key] == value for state in states):
            continue
        own = [np.broadcast_to(np.reshape(state[key], (-1, 1, 1)), (count, 1, 1)) for state in states]
        joined[key] = np.concatenate(own)
    return joined


def _cut_off(images: Sequence[np.ndarray]) -> bool:
    """Whether readings of 0 are those of an instrument that shows none below: CUT_OFF or more, and none below."""
    return all((image >= 0).all() for image in images) and sum(int((image == 0).sum()) for image in images) >= CUT_OFF


def _with_files(captures: Captures, scene: Scene) -> Captures:
    """The set with the files that its settings name (a map of regions) as paths, where they lie in its folder."""

    def found(settings: Mapping) -> dict:
        own = dict(settings)
        for key, value in settings.items():
            parameter = scene.parameters.get(key)
            if parameter is not None and parameter.files and str(value).endswith(parameter.files):
                file = captures.folder / str(value)
                if file.is_file():
                    own[key] = str(file.resolve())
                    captures.files[str(value)] = file
        return own

    frames = [replace(f, parameters=found(f.parameters)) for f in captures.frames]
    return replace(captures, parameters=found(captures.parameters), frames=frames)
