"""What Mitsuba needs of a part: the variant, the plugin classes built for it, and a base that reads and exposes
parameters."""

from __future__ import annotations

from collections.abc import Callable

from optics.errors import BadPlugin, UnknownKey
from optics.scene.declare import Part
from optics.scene.parameter import Parameter
from optics.scene.registry import Registry, registry

DEFAULT_VARIANT = "llvm_ad_spectral_polarized"


def use_variant(variant: str = DEFAULT_VARIANT) -> None:
    """Set the Mitsuba variant and register the plugin classes for it.

    Classes belong to the variant that they were built under, so they are built once per variant and registered again
    whenever it is set. Scalar variants are refused: Python plugins run 30-120 times slower in them and emitters fail.
    """
    from optics.doctor import require_llvm

    if variant.startswith("scalar"):
        raise ValueError(f"variant {variant}: scalar variants are not supported; use {DEFAULT_VARIANT}")
    if variant.startswith("llvm"):
        require_llvm()
    import mitsuba as mi

    if variant not in mi.variants():
        raise UnknownKey(variant, [v for v in mi.variants() if not v.startswith("scalar")], "variant")
    if mi.variant() != variant:
        mi.set_variant(variant)
        mi.set_log_level(mi.LogLevel.Error)
    reg = registry()
    if variant in reg.classes:
        return
    classes = {kind: _built(reg, part) for kind, part in reg.parts.items()}
    for kind, cls in classes.items():
        getattr(mi, f"register_{reg.parts[kind].category}")(kind, lambda props, cls=cls: cls(props))
    reg.classes[variant] = classes


def _built(reg: Registry, part: Part) -> type:
    """The Mitsuba class of a part, which parameters must not hide anything of."""
    cls = part.build()
    for p in reg.parameters_of(part.kind):
        if is_taken(p.name, cls):
            files = [e.file for e in reg.effects.values() if e.part == part.kind and p in (*e.parameters, *e.shape)]
            raise BadPlugin(
                f"{files[0] if files else part.file}: parameter '{p.name}' has the name of something else that the part "
                f"'{part.kind}' has; choose another name"
            )
    return cls


_created: list | None = None  # parts made while a scene is being loaded


class collecting:
    """Context in which the parts that Mitsuba creates are listed, in the order of creation."""

    def __enter__(self) -> list:
        global _created
        self.outer, _created = _created, []
        return _created

    def __exit__(self, *_):
        global _created
        _created = self.outer


class Declared:
    """What every part can do: read its declared parameters from XML, expose them, know its effects.

    A plugin class derives from `Declared.on(mi.BSDF)` and names its `kind` (Mitsuba's classes allow one base only).
    """

    kind: str
    band: float | None = None  # nm: what a mono variant renders, where the scene's integrator names one band

    @staticmethod
    def on(base: type) -> type:
        """A subclass of a Mitsuba class that has the methods of this one."""
        return type(
            f"Declared{base.__name__}",
            (base,),
            {
                n: f
                for n, f in vars(Declared).items()
                if (callable(f) or n == "band") and not n.startswith("__") and n not in ("on", "on_mesh")
            },
        )

    @staticmethod
    def on_mesh() -> type:
        """`on(mi.Mesh)` for a shape that makes its own vertices: `rebuild(params)` follows every change of its
        parameters."""
        import mitsuba as mi

        class DeclaredMesh(Declared.on(mi.Mesh)):
            def traverse(self, cb):
                mi.Mesh.traverse(self, cb)
                self.put_parameters(cb)

            def parameters_changed(self, keys=()):
                if any(key in self.numbers for key in keys) or not keys:
                    self.reread(keys)
                    self.rebuild(mi.traverse(self))
                else:
                    mi.Mesh.parameters_changed(self, list(keys))

        return DeclaredMesh

    def declare(self, props) -> None:
        """Read every declared parameter from `props` (unknown ones stay for Mitsuba to complain about)."""
        self.name = props.id()
        self.numbers: dict[str, Parameter] = {}
        self.words: dict[str, Parameter] = {}
        self.held: dict[str, float] = {}  # the numbers as Python floats, to ask without waiting for the device
        for p in registry().parameters_of(self.kind):
            value = p.check(props.get(p.name, p.default), f"{self.name}.{p.name}", "scene")
            if p.is_number:
                self.numbers[p.name] = p
                self.hold(p.name, value)
            else:
                self.words[p.name] = p
                setattr(self, p.name, value)
        if _created is not None:
            _created.append(self)

    def traverse(self, cb) -> None:
        self.put_parameters(cb)

    def parameters_changed(self, keys=()) -> None:
        self.reread(keys)

    def put_parameters(self, cb) -> None:
        import mitsuba as mi

        for name in getattr(self, "numbers", ()):
            cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

    def hold(self, name: str, value: float) -> None:
        """Set a number, as an evaluated variable: a literal would be compiled into every kernel."""
        import drjit as dr
        import mitsuba as mi

        setattr(self, name, dr.opaque(mi.Float, value))
        self.held[name] = float(value)

    def reread(self, keys=()) -> None:
        """After a change through mi.traverse: take the numbers over."""
        for name in keys or self.held:
            if name in self.held:
                self.held[name] = float(getattr(self, name)[0])

    def number(self, name: str) -> float:
        return self.held[name]

    def takes(self, name: str) -> bool:
        """Whether a parameter does anything where the part stands in its scene."""
        return True

    def functions(self, stage: str) -> tuple[Callable, ...]:
        """The functions of effects at a stage, but for those that rest at neutral and carry no derivative.

        Leaving them out saves time and changes nothing: the contract tests hold every effect to the identity at
        neutral. A part of an earlier scene knows no effect that was scanned since."""
        import drjit as dr

        return tuple(
            e.stages[stage]
            for e in registry().at_stage(self.kind, stage)
            if any(
                n in self.held and (self.held[n] != self.numbers[n].neutral or dr.grad_enabled(getattr(self, n)))
                for n in e.parameter_names
            )
        )


HELD = ("name", "numbers", "words", "held")  # what every part holds beside its parameters


def is_taken(word: str, cls: type = Declared) -> bool:
    """Whether a part has something of this name, which a parameter would hide."""
    return word in HELD or hasattr(cls, word)


def is_part(thing) -> bool:
    """Whether a Mitsuba object is a part of ours."""
    return hasattr(type(thing), "put_parameters")
