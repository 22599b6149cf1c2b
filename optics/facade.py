"""What scripts and the command line call: load a scene, calibrate, ask what is missing, add it, report.

    import optics

    study = optics.calibrate("captures", "study")     # base model; every fourth group of frames is held out
    verdict = study.diagnose()                        # which effect is missing? one of six verdicts
    verdict.plot()
    study.add("lens vignetting")                      # free it, calibrate everything again
    study.report()                                    # one HTML page

Nothing is printed and no window is opened. Results are values that show themselves in a notebook; `records()` gives
tables as lists of dictionaries, and `plot()` a matplotlib Figure."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optics import words
from optics.captures import capture_set as capture_files
from optics.diagnosis.result import Diagnosis, Row
from optics.fit.compare import Comparison
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.scene import trust
from optics.scene.declare import Effect
from optics.scene.loader import Scene
from optics.scene.mitsuba_parts import DEFAULT_VARIANT
from optics.scene.parameter import Values
from optics.scene.trust import Named
from optics.study import loop
from optics.study.calibrated import noise_of, plugins_of_fit, scene_of, tested
from optics.study.checks import repeated_images, without_shading
from optics.study.fit_files import fit_file, read_fit, values_of
from optics.study.record import Record, readable
from optics.study.setup import Setup, open_model, recorded, setup_for, split
from optics.study.shown import Shown, shown_frames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from optics.diagnosis.rehearse import Rehearsal

Progress = Callable[[str, int, int], None]  # (what, done, total)
Prior = tuple[float | None, float]  # (mean, standard deviation); a mean of None is the present value


def load(
    scene: str | Path | None = None,
    defines: Mapping[str, object] | None = None,
    *,
    fit: str | Path | None = None,
    frame: str | None = None,
    variant: str = DEFAULT_VARIANT,
    plugins: Named = None,
) -> Scene:
    """A scene by its shipped name or the path of its XML; or the calibrated sensor that a study found.

    defines   replace the XML's <default>s, such as {"depth": 0.5}
    fit       a study's folder (its last step) or a fit.toml: the scene that it belongs to, with the values that were
              found; `scene` may be left out
    frame     of the fit's captures: with what was set and found in it. None: with the values that all frames share
    variant   of Mitsuba, which is set
    plugins   further folders of plugins, or files: what is named runs. None: those that lie in a folder `plugins`
              beside the scene, or that the fit names, where they are trusted (optics.scene.trust); "none": only what
              ships

    Raises UnknownKey for an unknown name, definition or frame, BadScene for what cannot be loaded or where the fit
    belongs to another scene.
    """
    given = {name: str(value) for name, value in (defines or {}).items()}
    if fit is not None:
        from optics.study.calibrated import calibrated

        sensor = calibrated(fit, frame=frame, scene=scene, defines=given, variant=variant, plugins=plugins)
        for text in sensor.notes:
            warnings.warn(text, stacklevel=2)
        sensor.scene.set(sensor.values)
        return sensor.scene
    from optics.scene import loader

    if scene is None:
        raise ValueError("no scene; allowed: a shipped scene's name, the path of an XML file, or fit=STUDY")
    if frame is not None:
        raise ValueError(f"frame = {frame!r} without a fit; a scene alone has no frames: add fit=STUDY")
    return loader.load(scene, given, variant, plugins)


def calibrate(
    captures: str | Path,
    folder: str | Path,
    *,
    fit: str | Path | None = None,
    free: Sequence[str] = (),
    per_group: Sequence[str] | None = None,
    priors: Mapping[str, Prior] | None = None,
    held_out: Sequence[str] | None = None,
    values: Mapping[str, float | str] | None = None,
    defines: Mapping[str, object] | None = None,
    plugins: Named = None,
    flat_field: str | None = None,
    region: str = "",
    outside: bool = False,
    robust: bool = False,
    seed: int = 0,
    title: str = "",
    command: Sequence[str] = (),
    resume: bool = False,
    progress: Progress | None = None,
) -> Study:
    """Start a study: solve for the base model's free parameters in three stages, and test it on held-out frames.

    captures    folder with captures.toml; folder: of the new study, which appears with its first step
    fit         a study's folder (its last step) or a fit.toml, to start from: what all its frames share becomes start
                values, effects that it added stay at their strengths, and its definitions and plugins hold. None: the
                scene's values
    free        key patterns with one value for all frames, such as "led_*.x". Empty: position, axis, lobe and power of
                every LED, reflectance and roughness of every membrane, and a prior of 30 % on powers; before a crowd of
                beads also the camera's pose and field of view, with priors of 0.2 mm and 0.5 deg
    per_group   key patterns with a value per group of frames. None: place and depth of each press, with a prior of
                0.05 mm about what the stage said; []: none
    priors      pattern -> (mean, standard deviation)
    held_out    groups of frames to test on and not to fit. None: every fourth, where there are four or more; []: none
    values      start values, by key, above those of the fit;   defines, plugins: as in `load`
    flat_field  how a background image enters: "multiplicative", "additive" or "none"; None: as the captures ask
    region      what is fitted and judged: "all" of each image, or "known": the contact and the level face far from it,
                whose shapes are known; "": as the captures ask, else all
    outside     images and tables that captures.toml names may lie outside its folder
    robust      residuals beyond three sigmas count less (Huber)
    resume      continue the study in `folder`, if its inputs are the same
    command     what a report says the study was made by

    What an imported capture set advises (import.json) stands for what is not given. Raises BadCapture, BadScene,
    UnknownKey or Underdetermined before anything is rendered, OutputExists for a folder that holds a study.
    """
    from optics.files.output import check_folder

    check_folder(Path(folder))
    start: Mapping[str, float | str] = {}
    if fit is not None:
        origin, defines, plugins = _taken_from(fit, captures, defines, plugins, outside)
        start = origin["parameters"]
    setup = setup_of(
        captures,
        free=_listed(free) or [],
        per_group=_listed(per_group),
        priors=dict(priors or {}),
        held_out=_listed(held_out),
        values={**start, **(values or {})},
        defines=defines,
        plugins=plugins,
        flat_field=flat_field,
        region=region,
        outside=outside,
        robust=robust,
        seed=seed,
    )
    record, model, found = loop.begin(setup, folder, title=title, command=command, resume=resume, progress=progress)
    return Study(record, model, found)


def compare(
    captures: str | Path,
    fit: str | Path | None = None,
    *,
    values: Mapping[str, float | str] | None = None,
    held_out: Sequence[str] | None = None,
    defines: Mapping[str, object] | None = None,
    plugins: Named = None,
    flat_field: str | None = None,
    region: str = "",
    outside: bool = False,
) -> Compared:
    """Captures measured against a scene's predictions, without fitting anything.

    fit        a study's folder (its last step) or a fit.toml: its values, definitions, plugins, flat field and region.
               On the captures of the study the numbers are the study's own: values of held-out frames are those that it
               found
    values     by key, above those of the fit
    held_out   groups that the fit has not seen; None: those that it held out
    defines, plugins, flat_field, region   replace those of the fit
    outside    images and tables that captures.toml names may lie outside its folder

    Raises BadScene where the fit belongs to another scene than the captures.
    """
    origin: Mapping[str, Any] = {}
    noise = None
    if fit is not None:
        data, defines, plugins = _taken_from(fit, captures, defines, plugins, outside)
        origin = data["sensor"]
        noise = noise_of(fit_file(fit), origin["noise"]) if origin.get("noise") else None
    setup = setup_of(
        captures,
        defines=defines,
        plugins=plugins,
        flat_field=flat_field or origin.get("flat_field"),
        region=region or origin.get("region", ""),
        outside=outside,
        uncertainty=dict(origin.get("uncertainty", {})),
    )
    model = open_model(setup, fitted=noise)
    present = values_of(
        model, fit, {**({} if fit is not None else setup.values), **model.scene.spread(values or {}, "values")}
    )
    comparison, notes = tested(model, present, fit, _listed(held_out))
    return Compared(model, present, comparison, [*notes, *without_shading(model), *repeated_images(model)])


def _taken_from(
    fit: str | Path,
    captures: str | Path,
    defines: Mapping[str, object] | None,
    plugins: Named,
    outside: bool = False,
) -> tuple[dict[str, dict], Mapping[str, object], Named]:
    """(a fit's tables, definitions, plugins) for captures; what is given stands above the fit's, and images
    have the size that they have. Raises BadScene where the fit belongs to another scene than the captures."""
    file = fit_file(fit)
    data = read_fit(file)
    origin = data["sensor"]
    scene, _ = scene_of(file, origin, capture_files.load(captures, outside).scene)
    found = {k: v for k, v in origin.get("defines", {}).items() if k not in ("width", "height")}
    return data, {**found, **(defines or {})}, plugins_of_fit(file, origin, scene) if plugins is None else plugins


def setup_of(captures: str | Path, *, defines: Mapping[str, object] | None, plugins: Named, **more: Any) -> Setup:
    """The setup of a study; its paths are absolute, so that it can be continued from any folder."""
    return setup_for(
        os.path.abspath(captures),
        defines={name: str(value) for name, value in (defines or {}).items()},
        plugins=None if plugins is None else [os.path.abspath(p) for p in trust.named(plugins) or ()],
        **more,
    )


def _listed(names: Sequence[str] | None) -> list[str] | None:
    """A list of names, of one name too."""
    return None if names is None else [names] if isinstance(names, str) else list(names)


class Compared:
    """A comparison, with the model and the values that it is of.

    comparison   optics.fit.compare.Comparison: misfit by frame, LED, region and channel
    notes        how the captures stand to those of the fit, where it is not plain
    """

    def __init__(self, model: SceneModel, values: Values, comparison: Comparison, notes: Sequence[str] = ()):
        self.model, self.values, self.comparison, self.notes = model, values, comparison, list(notes)

    def frames(self, indices: Sequence[int] | None = None) -> list[Shown]:
        """Measured, predicted and residual of frames; None: of all."""
        return shown_frames(self.model, self.values, frames=indices)


class Study:
    """A study: captures, a model of them, and the ladder of effects that it took to explain them.

    `optics.calibrate` starts one and `Study.open` opens one. Each step is on disk when a method returns, so another
    process, or the command line, can continue the study.

    folder   of the study;   record: its files (optics.study.record);   setup: what it started from
    """

    def __init__(self, record: Record, model: SceneModel | None = None, fit: Fit | None = None):
        self.record = record
        self.setup = recorded(record.ladder["facts"]["setup"]) if "setup" in record.ladder["facts"] else Setup("")
        self._model, self._fit = model, fit
        self._plugins: Named = None
        self._captures: str | Path | None = None
        self._verdict: Diagnosis | None = None  # of the last step, with its refits

    @classmethod
    def open(cls, folder: str | Path, *, plugins: Named = None, captures: str | Path | None = None) -> Study:
        """An existing study. Raises FileNotFoundError, or ValueError where it cannot be read.

        plugins    folders or files that run besides those that the study was made with; None: those that are found with
                   it, where they are trusted (optics.scene.trust)
        captures   where its captures are by now, if they are not found where they were, as seen from the study
        """
        with readable(Path(folder)):
            study = cls(Record.open(folder))
        study._plugins, study._captures = plugins, captures
        return study

    # -- what it holds ------------------------------------------------------------------------------------------------
    @property
    def folder(self) -> Path:
        return self.record.folder

    @property
    def title(self) -> str:
        return self.record.ladder["title"] or self.folder.name

    @property
    def warnings(self) -> list[str]:
        """What is doubtful about the captures and the noise."""
        return list(self.record.ladder["warnings"])

    @property
    def effects(self) -> list[str]:
        """Names of the effects that were added and not dropped, in their order."""
        steps = {step["effect"]: step for step in self.record.steps}
        names = {k: s["name"].rsplit(" without ", 1)[0] if s.get("dropped") else s["name"] for k, s in steps.items()}
        return [names[key] for key in self.record.added()]

    @property
    def model(self) -> SceneModel:
        """The scene with its captures; loaded when first asked for. Raises BadCapture where an input has changed."""
        if self._model is None:
            with readable(self.folder):
                self.record, self._model, self.setup = loop.take_up(self.folder, self._plugins, self._captures)
        return self._model

    @property
    def fit(self) -> Fit:
        """The last step's fit; of an opened study it is restored: same values, with errors computed anew."""
        if self._fit is None:
            self._fit = loop.restore(self.record, self.model)
        return self._fit

    @property
    def diagnosis(self) -> Diagnosis | None:
        """The last step's diagnosis as recorded; None where none was made."""
        found = self.record.diagnosis(len(self.record.steps) - 1) if self.record.steps else None
        return None if found is None else Diagnosis.from_json(json.dumps(found))

    def comparison(self, step: int = -1) -> Comparison:
        """Measured against predicted at a step: misfit by frame, LED, region and channel."""
        return self.record.comparison(self._index(step))

    def frames(self, step: int = -1) -> list[Shown]:
        """The frames whose images a step keeps: measured, predicted, residual in sigmas."""
        return self.record.frames(self._index(step))

    def candidates(self) -> list[Effect]:
        """The effects that the scene can express and the study has not added."""
        return loop.candidates(self.model, self.record)

    def _index(self, step: int) -> int:
        count = len(self.record.steps)
        if not -count <= step < count:
            names = ", ".join(f"{i} ({s['name']})" for i, s in enumerate(self.record.steps))
            raise IndexError(f"{self.folder}: no step {step}; there are {names}")
        return step % count

    # -- verbs --------------------------------------------------------------------------------------------------------
    def diagnose(
        self,
        *,
        without: Sequence[str] = (),
        advised: bool = True,
        progress: Progress | None = None,
        ranked: Callable[[list[Row]], None] | None = None,
    ) -> Diagnosis:
        """Ask what the last step lacks: every effect scored, the best added and refitted, one of six verdicts.

        without   names of effects that are not tested
        advised   where effects tie, simulate further frames and say which would tell them apart
        ranked    called with the ranking by score, before anything is refitted; the step's ranking.csv holds it too

        Images whose fitted frames have more than 60,000 values are diagnosed in cells of up to 4 x 4 pixels; a warning
        says so. Raises UnknownKey for an unknown effect.
        """
        model = self.model
        left_out = _listed(without) or []
        loop.excluded(model, self.record, left_out)  # a wrong name costs no fit
        asked = (progress, advised, left_out, ranked)
        cells = loop.cells_of(self.record, model)
        if cells is None:
            self._verdict = loop.examine(self.record, model, self.setup, self.fit, *asked)
        else:
            self._verdict = loop.examine_in_cells(self.record, model, self.setup, cells, *asked)
        return self._verdict

    def add(
        self,
        effect: str,
        *,
        drop: str | Sequence[str] = (),
        start: Values | None = None,
        progress: Progress | None = None,
    ) -> Fit:
        """Free an effect, calibrate everything again, and record it as the next step.

        effect   its name or key, as `optics effects` lists them
        drop     effects that were added before and that this one replaces: the model is without them from here on
        start    values to begin from; None: those of the diagnosis's refit, if this object has diagnosed the last step,
                 else the present values with the effect a little off neutral

        Raises UnknownKey for an unknown effect, ValueError for one that the study has, or has not to drop.
        """
        model = self.model
        chosen = model.scene.registry.find_effect(effect)
        dropped = list({e.key: e for e in map(model.scene.registry.find_effect, _listed(drop) or ())}.values())
        for other in dropped:
            if other.key not in self.record.added():
                raise ValueError(
                    f"{self.folder}: '{other.name}' is no part of the study, so that it cannot be dropped; allowed: "
                    f"{', '.join(self.effects) or 'nothing, as no effect was added'}"
                )
        if chosen.key in self.record.added():
            raise ValueError(
                f"{self.folder}: '{chosen.name}' is part of the study already; `optics diagnose {self.folder}` asks "
                "what else is missing"
            )
        if start is None and self._verdict is not None and chosen.name in self._verdict.fits:
            start = self._verdict.fits[chosen.name].values
        self._fit, _ = loop.extend(self.record, model, self.setup, self.fit, chosen, start, progress, dropped)
        self._verdict = None
        return self._fit

    def rehearse(self, change: float = 0.005, *, progress: Progress | None = None) -> Rehearsal:
        """Which effects would be found in these captures, were they hidden in them, and what each would be taken for.

        change   rms over the mean signal by which each hidden effect changes the images, before any calibration
        """
        from optics.diagnosis.rehearse import rehearse
        from optics.study.setup import effect_variables

        model, fit = self.model, self.fit
        fitted, _ = split(model, self.setup)
        return rehearse(
            model,
            fit,
            self.candidates(),
            lambda e: effect_variables(model, e),
            fitted,
            change=change,
            seed=self.setup.seed,
            progress=progress,
        )

    def imitate(
        self,
        folder: str | Path,
        values: Mapping[str, float | str] | None = None,
        *,
        seed: int = 1,
        into_captures: bool = False,
    ) -> Path:
        """Write captures as the study's model would take them, with `values` put in; returns the folder.

        into_captures   write the measured images instead, changed by what `values` change: they keep their own noise
                        and all that the model lacks. BadCapture where nothing changes
        """
        from optics.diagnosis.rehearse import imitate

        model = self.model
        _, present, _ = loop.kept(self.record, model)  # with what was found in held-out frames
        changed = present.copy()
        changed.common.update(model.scene.check(values or {}, "values"))
        return imitate(model, changed, folder, seed, present if into_captures else None)

    def report(self, file: str | Path | None = None, *, overwrite: bool = False) -> Path:
        """Write the study as one HTML page; returns its path (None: report.html in the study's folder)."""
        from jinja2 import UndefinedError

        from optics.pages.report import report

        with readable(self.folder, UndefinedError):
            return report(self.folder, file or self.folder / "report.html", overwrite=overwrite)

    def view(self, step: int | None = None, *, port: int = 0, ready: Callable[[str], None] = lambda url: None) -> None:
        """Serve the live page of a step (None: the last) on this machine until Ctrl-C; `ready` is told its address."""
        from optics.pages import view

        view.serve(self.folder, port, step, ready, plugins=self._plugins, captures=self._captures)

    # -- the ladder ---------------------------------------------------------------------------------------------------
    def records(self) -> list[dict[str, Any]]:
        """One record per step: index, name, effect, converged, reason, seconds, parameters, and for fitted_ and
        held_out_ each chi2_per_dof, misfit and noise (of the mean signal), n. None where nothing is held out."""
        out = []
        for step in self.record.steps:
            row = {key: step[key] for key in ("index", "name", "effect", "converged", "reason", "seconds")}
            row["parameters"] = len(step["variables"])
            for part in ("fitted", "held_out"):
                level = step[part] or {}
                row |= {f"{part}_{key}": level.get(key) for key in ("chi2_per_dof", "misfit", "noise", "n")}
            out.append(row)
        return out

    def table(self) -> str:
        """The ladder as aligned text."""
        return self.record.table()

    def plot(self) -> Figure:
        """The ladder: chi2 per degree of freedom of each step, on fitted and on held-out frames, and the noise
        floor."""
        from optics.files.charts import BLUE, GREY, ORANGE, RED, chart

        rows = self.records()
        names = [("+ " if r["index"] else "") + r["name"] for r in rows]
        figure, axis = chart(max(4.5, 1.6 * len(rows) + 2), 3.4)
        highest = 1.0
        for part, label, colour, line in (("held_out", "held out", BLUE, "o-"), ("fitted", "fitted", ORANGE, "s--")):
            points = [(i, v) for i, r in enumerate(rows) if (v := r[f"{part}_chi2_per_dof"]) is not None]
            if not points:
                continue
            axis.plot(*zip(*points), line, ms=5, color=colour, label=label)
            highest = max(highest, *(v for _, v in points))
            if part == "held_out":
                for at in points:
                    axis.annotate(f"{at[1]:.3g}", at, xytext=(6, 6), textcoords="offset points", fontsize=9)
        axis.axhline(self.record.ladder["noise_floor"]["chi2_per_dof"], color=RED, lw=1, label="noise floor")
        axis.set_xticks(range(len(names)), names)
        axis.set(ylabel="chi2 per degree of freedom", xlim=(-0.4, len(names) - 0.4))
        if highest > 5:
            axis.set_yscale("log")
        axis.margins(y=0.2)
        axis.grid(axis="y", color=GREY, alpha=0.2)
        axis.legend(fontsize=9)
        axis.set_title(self.title, fontsize=11)
        return figure

    def __repr__(self) -> str:
        steps = " + ".join(step["name"] for step in self.record.steps)
        return f"Study({str(self.folder)!r}: {steps or 'no step yet'})"

    def _repr_html_(self) -> str:
        lines = [
            (
                ("+ " if r["index"] else "") + r["name"],
                words.figures(r["fitted_chi2_per_dof"]),
                words.figures(r["held_out_chi2_per_dof"]),
                words.percent(r["held_out_misfit"], typeset=True),
                words.percent(r["held_out_noise"], typeset=True),
                str(r["parameters"]),
                "" if r["converged"] else f"not converged: {r['reason']}",
            )
            for r in self.records()
        ]
        head = ("step", "fitted χ²/dof", "held-out χ²/dof", "held-out misfit", "noise", "parameters", "")
        ladder, verdict = self.record.ladder, self.diagnosis
        said = (
            f"<p>{words.escaped(verdict.word.replace('_', ' '))}: {words.escaped(verdict.sentence)}</p>"
            if verdict
            else ""
        )
        return words.html_block(
            f"Study: {self.title}",
            words.html_table(head, lines, left=(0, 6)),
            said,
            words.html_list([f"warning: {w}" for w in self.warnings]),
            note=f"{ladder['captures']} with the scene {ladder['scene']}; in {self.folder}",
        )
