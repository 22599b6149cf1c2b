"""What every command shares: the terminal, common options, reading arguments, and how errors are reported."""

import atexit
import enum
import functools
import inspect
import json
import math
import os
import re
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optics.fit.crew import use_processes
from optics.version import __version__
from optics.words import fitting

if TYPE_CHECKING:
    from optics.scene.loader import Scene
    from optics.scene.registry import Registry
    from optics.study.calibrated import Calibrated

INTERRUPTED = 130  # 128 and the number of SIGINT, as shells count

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    help="Optical models of camera-based touch sensors, compared with measurements.",
)


EVERY = 10.0  # seconds between lines of progress where there is no terminal


def say(text: str) -> None:
    """A line on stderr. Where stderr takes none, as on a full disk, it and what follows are lost; the work goes on."""
    try:
        print(text, file=sys.stderr, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


class Terminal:
    """The terminal of a command: `note` writes remarks to stderr, `progress` draws a bar there. Results are printed."""

    quiet = False
    debug = False
    stopped = False  # whether Ctrl-C came: a package may swallow it, as trimesh does where it imports its own parts
    interrupted = False  # whether that was said

    def note(self, text: str) -> None:
        if not self.quiet:
            say(text)

    def stop(self, number: int, frame: FrameType | None) -> None:
        """What Ctrl-C does; a moment later where nanobind makes an enumeration, in C++ that ends the program by abort
        when an exception comes through."""
        self.stopped = True
        if frame is not None and frame.f_code.co_filename == enum.__file__:
            signal.signal(signal.SIGALRM, self.stop)
            signal.setitimer(signal.ITIMER_REAL, 0.01)
            return
        signal.default_int_handler(number, frame)

    def go_on(self) -> None:
        """Raises KeyboardInterrupt after Ctrl-C."""
        if self.stopped:
            raise KeyboardInterrupt

    @contextmanager
    def progress(self) -> Iterator[Callable[[str, int, int], None] | None]:
        """A function (what, done, total) that draws a bar, or, where stderr is no terminal, writes a line now and then;
        None with --quiet. It raises a Ctrl-C that was swallowed."""
        if self.quiet:
            yield None
            return
        if not sys.stderr.isatty():
            yield _lines()
            return
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        tasks: dict[str, Any] = {}

        def show(what: str, done: int, total: int) -> None:
            self.go_on()
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total)
            bars.update(tasks[what], completed=done, total=total)

        with bars:
            yield show

    @contextmanager
    def live(self) -> Iterator[Callable[[Mapping[str, str]], None] | None]:
        """A function (title -> text) that keeps a table of one row up to date, or, where stderr is no terminal, writes
        it as a line now and then; None with --quiet."""
        if self.quiet:
            yield None
            return
        if not sys.stderr.isatty():
            last = time.monotonic()

            def line(cells: Mapping[str, str]) -> None:
                nonlocal last
                if time.monotonic() - last >= EVERY:
                    last = time.monotonic()
                    say(", ".join(f"{title} {text}" for title, text in cells.items()))

            yield line
            return
        from rich.console import Console
        from rich.live import Live
        from rich.table import Table

        def table(cells: Mapping[str, str]) -> Table:
            rows = Table(*cells, box=None, pad_edge=False)
            rows.add_row(*cells.values())
            return rows

        with Live(console=Console(stderr=True), transient=True, refresh_per_second=4) as shown:
            yield lambda cells: shown.update(table(cells))


def _lines() -> Callable[[str, int, int], None]:
    """Progress as lines, one every EVERY seconds: quick work writes none. What begins anew gets a number: a study
    calibrates several times."""
    last, reached, times = time.monotonic(), dict[str, int](), Counter[str]()

    def show(what: str, done: int, total: int) -> None:
        nonlocal last
        terminal.go_on()
        times[what] += done < reached.get(what, math.inf)
        reached[what] = done
        if time.monotonic() - last >= EVERY:
            last = time.monotonic()
            say(f"{what}{f' ({times[what]})' * (times[what] > 1)}: {done} of {total}")

    return show


terminal = Terminal()

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no remarks.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show where in the program an error came from.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
SceneName = Annotated[
    str, typer.Argument(metavar="SCENE", help="A shipped scene's name (`optics scenes`) or an XML file.")
]
SceneOrFit = Annotated[
    str | None,
    typer.Argument(
        metavar="SCENE",
        help="A shipped scene's name (`optics scenes`) or an XML file.",
        show_default="that of --fit",
    ),
]
CaptureSet = Annotated[str, typer.Argument(metavar="CAPTURES", help="Folder with captures.toml.")]
StudyFolder = Annotated[Path, typer.Argument(metavar="STUDY", help="Folder that `optics calibrate` made.")]
Defines = Annotated[
    list[str] | None,
    typer.Option("-D", "--define", metavar="NAME=VALUE", help="Replace a <default> of the scene's XML. Repeatable."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Set a parameter, or all that match a pattern, 'led_*.mu=1' (`optics params SCENE` lists them). "
        "Repeatable.",
    ),
]
Plugins = Annotated[
    list[Path] | None,
    typer.Option(
        "--plugins",
        metavar="PATH",
        help="Run the plugins of this folder, or this file. Repeatable. 'none': only the shipped ones. Without this "
        "option, plugins beside the scene or the captures run once you have agreed.",
    ),
]
CapturesNow = Annotated[
    Path | None,
    typer.Option("--captures", metavar="DIR", help="Where the study's captures are now, if they were moved."),
]
Outside = Annotated[
    bool, typer.Option("--allow-outside", help="Let captures.toml name images and tables outside its folder.")
]
FitFile = Annotated[
    Path | None,
    typer.Option(
        "--fit", metavar="FIT", help="A calibrated sensor: a study's folder (its last step), or a fit.toml of it."
    ),
]
FrameName = Annotated[
    str | None,
    typer.Option(
        "--frame",
        metavar="NAME",
        help="With --fit: use the settings of this frame of its captures, and the values found in it.",
        show_default="the values that all frames share",
    ),
]
Variant = Annotated[
    str | None,
    typer.Option("--variant", help="Mitsuba variant, such as cuda_ad_spectral_polarized.", show_default=False),
]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
At = Annotated[
    str | None,
    typer.Option(
        "--at",
        metavar="U,V",
        help="Pixel position, u right and v down from the top left.",
        show_default="the image's centre",
    ),
]
FlatField = Annotated[
    str | None,
    typer.Option(
        "--flat-field", metavar="MODE", help="How a background image enters: multiplicative, additive or none."
    ),
]
Region = Annotated[
    str,
    typer.Option(
        "--region",
        metavar="all|known",
        help="Which pixels are fitted and tested. all: the whole image; known: only where the shape is known, in the "
        "contact and on the level face far from it.",
        show_default="all, or what an import advises",
    ),
]


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Register a command, with the options that every command has."""

    @functools.wraps(function)
    def run(*args: Any, quiet: bool = False, debug: bool = False, **options: Any) -> None:
        terminal.quiet, terminal.debug = quiet, debug
        try:
            _let_ask()
            use_processes()
            check_finite(function, options)
            function(*args, **options)
            sys.stdout.flush()
        except BrokenPipeError:  # whoever read our output has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        except (Exception, KeyboardInterrupt) as error:
            stopped = _ctrl_c(error)  # typer would end silently
            if stopped is None:
                raise
            raise typer.Exit(_interrupted(*stopped.args)) from None

    shared = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind)
        for name, kind in (("quiet", Quiet), ("debug", Debug))
    ]
    signature = inspect.signature(function)
    parameters = [*signature.parameters.values(), *shared]
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {**function.__annotations__, "quiet": Quiet, "debug": Debug}
    return app.command()(run)


def check_finite(function: Callable[..., None], options: Mapping[str, Any]) -> None:
    """Raises ValueError for an option that is infinite or no number: what is asked for is a size."""
    for name, value in options.items():
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, float) and not math.isfinite(number):
                told = getattr(function.__annotations__.get(name), "__metadata__", [None])[0]
                names = (getattr(told, "default", None), *(getattr(told, "param_decls", None) or ()))
                named = [n for n in names if isinstance(n, str) and n.startswith("--")]  # typer keeps the first apart
                option = named[0] if named else f"--{name.replace('_', '-')}"
                raise ValueError(f"{option} {number}: not finite; allowed: a finite number")


def _let_ask() -> None:
    """Where there is a terminal, plugins that came with data are asked about."""
    if sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty():
        from optics.scene import trust

        trust.ask = agree


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit code; without arguments, that of this program."""
    # Before numpy is imported: matrices are small, and a second thread of BLAS takes the core from Dr.Jit. Where other
    # work shares the cores, products of them took eight times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by who started the program
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115  for as long as the program runs
    if arguments is None:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored, as behind nohup
            signal.signal(signal.SIGINT, terminal.stop)
        try:
            code = _run(sys.argv[1:])
        except KeyboardInterrupt:
            code = _interrupted()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # what is left is to end
        if code == INTERRUPTED:
            # Python remembers an interrupt within `exec`, as imports use it, and would end by the signal instead
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
        return code
    return _run(arguments)


def _interrupted(*what: object) -> int:
    """Say once that the program was interrupted; returns its exit code."""
    if not terminal.interrupted:
        terminal.interrupted = True
        say(": ".join(["interrupted", *map(str, what)]))
    return INTERRUPTED


def _run(arguments: Sequence[str]) -> int:
    arguments = list(arguments) or ["--help"]
    terminal.quiet, terminal.debug, terminal.interrupted = False, "--debug" in arguments, False
    with warnings.catch_warnings():
        warnings.showwarning = lambda text, *_: terminal.note(f"warning: {one_line(text)}")
        try:
            with fitting(columns()):
                code = int(app(args=arguments, prog_name="optics", standalone_mode=False) or 0)
            return _interrupted() if code == INTERRUPTED else code  # typer says nothing of one outside a command
        except Exception as error:
            return _interrupted() if terminal.stopped else _report(error)


def _ctrl_c(error: BaseException | None) -> KeyboardInterrupt | None:
    """The Ctrl-C behind an error: within a render, Dr.Jit wraps it in an error of its own."""
    return (
        error
        if error is None or isinstance(error, KeyboardInterrupt)
        else _ctrl_c(error.__cause__ or error.__context__)
    )


def _report(error: Exception) -> int:
    """Report an error in one line; a bug with its traceback."""
    expected = isinstance(error, (ValueError, LookupError, OSError, RuntimeError, MemoryError)) or hasattr(
        error, "format_message"
    )
    if terminal.debug or not expected:
        say("".join(traceback.format_exception(type(error), error, error.__traceback__)).rstrip("\n"))
    text = _usage(error) if hasattr(error, "format_message") else _text(error)
    say(f"error: {one_line(text)}" + ("" if expected else " (a bug: please report it with the lines above)"))
    return 2


def _usage(error: Any) -> str:
    """Typer's message about a wrong option or argument, and where the right ones are listed."""
    context = getattr(error, "ctx", None)
    return error.format_message().rstrip(".") + (f"; see `{context.command_path} --help`" if context else "")


def _text(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        from optics.files.output import FULL

        if error.filename:
            return f"{error.filename}: {error.strerror}"
        if isinstance(error, FileNotFoundError) and not _is_somewhere():
            return "the current folder is gone; change to another one"
        # writers of files say theirs (optics.files.output.naming): what is left is a table, or text for a program
        return f"standard output: {error.strerror}" if error.errno in FULL else error.strerror
    if isinstance(error, MemoryError):
        return (
            f"not enough memory: {error or 'the system gave none'}; take fewer pixels (-D width=..., --bin) or frames"
        )
    if type(error) is KeyError:
        return f"no entry {error}"
    return str(error) or type(error).__name__


def _is_somewhere() -> bool:
    try:
        return bool(os.getcwd())
    except FileNotFoundError:
        return False


def columns() -> int | None:
    """How wide a table may be: the terminal's width; None where results go to a file or a program."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def one_line(text: object) -> str:
    return " ".join(str(text).split())


def show(result: object) -> None:
    """Print a result for programs."""

    def plain(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {str(k): plain(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(v) for v in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    print(json.dumps(plain(result), indent=1, allow_nan=False, default=str))


def pairs(items: Sequence[str] | None, option: str) -> dict[str, str]:
    """{name: text} of NAME=TEXT arguments."""
    found = {}
    for item in items or ():
        name, equals, text = item.partition("=")
        if not equals or not name.strip():
            raise ValueError(f"{option} {item}: no '='; allowed: {option} NAME=VALUE")
        found[name.strip()] = text.strip()
    return found


def settings(items: Sequence[str] | None) -> dict[str, float | str]:
    """{key: number or word} of --set arguments."""

    def value(text: str) -> float | str:
        try:
            return float(text)
        except ValueError:
            return text

    return {key: value(text) for key, text in pairs(items, "--set").items()}


def priors(items: Sequence[str] | None) -> dict[str, tuple[float | None, float]]:
    """{pattern: (mean, sd)} of PATTERN=MEAN+-SD arguments; without a mean (PATTERN=+-SD) it is the present value."""
    found = {}
    for pattern, text in pairs(items, "--prior").items():
        number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
        match = re.fullmatch(rf"({number})?\s*(?:\+-|\+/-|±)\s*({number})", text)
        if match is None or not float(match[2]) > 0:
            raise ValueError(
                f"--prior {pattern}={text}: allowed: PATTERN=MEAN+-SD with SD above 0, such as "
                "'led_*.x=11+-0.5', or PATTERN=+-SD about the present value"
            )
        found[pattern] = (float(match[1]) if match[1] else None, float(match[2]))
    return found


def load_scene(
    name: str, defines: Sequence[str] | None, plugins: Sequence[Path] | None, variant: str | None = None
) -> "Scene":
    """The scene of a command line."""
    from optics import facade

    return facade.load(name, pairs(defines, "-D"), variant=variant or facade.DEFAULT_VARIANT, plugins=plugins)


def load_sensor(
    name: str | None,
    fit: Path | None,
    frame: str | None,
    defines: Sequence[str] | None,
    plugins: Sequence[Path] | None,
    variant: str | None = None,
    driven: bool = True,
) -> "Calibrated":
    """The scene of a command line, or with --fit the calibrated sensor, whose scene need not be named."""
    from optics.scene.mitsuba_parts import DEFAULT_VARIANT
    from optics.study.calibrated import Calibrated, calibrated

    if fit is None:
        if frame is not None:
            raise ValueError(f"--frame {frame}: of which captures? Add --fit STUDY")
        if name is None:
            raise ValueError("no scene; allowed: a shipped scene's name (`optics scenes`), an XML file, or --fit STUDY")
        return Calibrated(load_scene(name, defines, plugins, variant), {})
    found = calibrated(
        fit,
        frame=frame,
        scene=name,
        defines=pairs(defines, "-D"),
        variant=variant or DEFAULT_VARIANT,
        plugins=plugins,
        driven=driven,
    )
    for text in found.notes:
        terminal.note(text)
    return found


def scan(plugins: Sequence[Path] | None) -> "Registry":
    """The registry of the shipped plugins, with further folders or files."""
    from optics.scene import trust
    from optics.scene.registry import known

    return known(*(trust.named(plugins) or ()))


def agree(files: Sequence[Path], where: str) -> bool:
    """Ask whether plugins that came with data may run, and say what follows."""
    from optics.scene.trust import store

    names = ", ".join(map(str, files))
    print(
        f"{names}: code {where}. It would run with all your rights. Run it, now and whenever its content is the same? "
        "[y/N] ",
        end="",
        file=sys.stderr,
        flush=True,
    )
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        return False
    say(f"trusted from now on: {names} (remembered in {store()})")
    return True


@app.callback(invoke_without_command=True)
def optics(
    version: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    if version:
        print(f"optics {__version__}")
        raise typer.Exit()
