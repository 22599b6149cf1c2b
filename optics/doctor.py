"""What this machine can run: finds a usable LLVM, and says in words what is missing and what to do next.

The processor variants of Mitsuba compile their kernels with the system's LLVM library. Dr.Jit 1.5 accepts LLVM 15 and
16 and then aborts the whole process in the first `dr.minimum`, so a library is tried in a process of its own before it
is used; the verdict is kept on disk. This file needs nothing but Python 3.8, so that it can also run before anything is
installed: `python3 -I optics/doctor.py --help`."""

from __future__ import annotations

import argparse
import glob
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
import warnings
from dataclasses import asdict, dataclass
from typing import NamedTuple

LLVM_PATH = "DRJIT_LIBLLVM_PATH"  # the variable that Dr.Jit reads, once, when it is imported
LLVM_FOLDERS = "OPTICS_LLVM_FOLDERS"  # folders to search for LLVM instead of the usual ones
CACHE_FOLDER = "OPTICS_CACHE_DIR"
LLVM_OLDEST = 17  # 14 is refused by Dr.Jit, 15 and 16 abort
LLVM_TESTED = 19
PYTHON_OLDEST, PYTHON_NEWEST = (3, 10), (3, 13)
PROBE_SECONDS = 60.0  # a trial takes a quarter of a second; a cold disk or a loaded machine may take several

PINS = {"mitsuba": "3.9.1", "drjit": "1.5.0"}
PACKAGES = (
    *PINS, "numpy", "scipy", "trimesh", "OpenEXR", "colour-science", "scikit-image", "pillow", "tifffile", "rich",
    "typer", "pydantic", "matplotlib", "tomlkit", "jinja2", "pyyaml", "cachetools",
)  # fmt: skip


class PlatformError(RuntimeError):
    """The machine lacks something that the program cannot do without; the text names the command that brings it."""


class UntestedPlatform(UserWarning):
    """Something on this machine works in a short trial, but the program has never been tested with it."""


class Llvm(NamedTuple):
    """An LLVM library on this machine; the version is read from the file name, None where the name does not say."""

    path: str
    version: tuple[int, ...] | None


@dataclass(frozen=True)
class Probe:
    """What came of loading one LLVM library in a process of its own.

    usable   False where the program must not use it; then reason says why
    version  as the library reports it, None where it could not say
    compiled whether Dr.Jit compiled and ran a kernel with it; False where Dr.Jit is not installed yet
    """

    path: str
    usable: bool
    version: tuple[int, ...] | None
    reason: str
    compiled: bool

    @property
    def name(self) -> str:
        return f"LLVM {version_text(self.version)} ({self.path})"


class Row(NamedTuple):
    """One line of the report: `state` is 'ok', 'warn' (works, but mind this) or 'fail'; `advice` is the next step."""

    name: str
    value: str
    state: str = "ok"
    advice: str = ""


def version_text(version: tuple[int, ...] | None) -> str:
    """Write (19, 1, 7) as 19.1.7."""
    return ".".join(map(str, version)) if version else "of unknown version"


# ------------------------------------------------------------------------------------------------------------ find LLVM

# libLLVM-14.so.1, libLLVM-14.0.6.so.1, libLLVM.so.19.1, libLLVM.dylib; not libLLVMSPIRVLib.so.15 nor libLLVMCore.a
_LIBRARY = re.compile(
    r"libLLVM(-(?P<before>\d+(\.\d+)*))?\.(so(\.(?P<after>\d+(\.\d+)*))?|dylib)|LLVM-C\.dll", re.IGNORECASE
)
_FOLDER_VERSION = re.compile(r"(?:llvm[-@]?|llvm[\\/])(\d+(?:\.\d+)*)", re.IGNORECASE)


def find_llvm(folders: list[str] | None = None) -> list[Llvm]:
    """List the LLVM libraries of this machine, the one to prefer first.

    The preferred one is what the user named in DRJIT_LIBLLVM_PATH; then the tested version, newer ones, older ones,
    those whose version only shows when they are loaded, and last those that are too old. With `folders`, or with the
    variable OPTICS_LLVM_FOLDERS, these folders are searched and nowhere else.
    """
    if folders is None and LLVM_FOLDERS in os.environ:
        folders = [folder for folder in os.environ[LLVM_FOLDERS].split(os.pathsep) if folder]
    files = _system_libraries() if folders is None else _libraries_in(folders)
    found: dict[str, Llvm] = {}  # by real path: one library has up to six names
    for file in files:
        real = os.path.realpath(file)
        version = _version_in_name(file) or _version_in_name(real)
        if os.path.isfile(real) and (real not in found or len(version or ()) > len(found[real].version or ())):
            found[real] = Llvm(real, version)
    ranked = sorted(found.values(), key=_preference)
    named = os.environ.get(LLVM_PATH)
    if named:
        real = os.path.realpath(named)
        known = found.get(real, Llvm(real, _version_in_name(named) or _version_in_name(real)))
        ranked = [Llvm(named, known.version), *(llvm for llvm in ranked if llvm.path != real)]
    return ranked


def _preference(llvm: Llvm) -> tuple:
    """Sort key of a library: tested, newer, older but possible, unknown, too old; within a class the newest first."""
    major = llvm.version[0] if llvm.version else None
    if major is None:
        rank = 3
    elif major < LLVM_OLDEST:
        rank = 4
    else:
        rank = 0 if major == LLVM_TESTED else 1 if major > LLVM_TESTED else 2
    return rank, [-number for number in llvm.version or ()], llvm.path


def _version_in_name(path: str) -> tuple[int, ...] | None:
    """Read the version of a library from its file name, else from its folders (`llvm-19/lib`, `Cellar/llvm/19.1.7`)."""
    match = _LIBRARY.fullmatch(os.path.basename(path))
    text = match and (match["before"] or match["after"])
    if not text:
        in_folder = _FOLDER_VERSION.findall(os.path.dirname(path))
        text = in_folder[-1] if in_folder else None
    return tuple(map(int, text.split("."))) if text else None


def _libraries_in(patterns: list[str]) -> list[str]:
    """List the LLVM libraries in these folders, which may be glob patterns."""
    return [
        os.path.join(folder, name)
        for pattern in patterns
        for folder in sorted(glob.glob(pattern))
        if os.path.isdir(folder) and os.access(folder, os.R_OK)
        for name in sorted(os.listdir(folder))
        if _LIBRARY.fullmatch(name)
    ]


def _system_libraries() -> list[str]:
    """List the LLVM libraries in the places where the package managers of this system put them."""
    if sys.platform == "win32":
        programs = [os.environ.get(name, "") for name in ("ProgramFiles", "ProgramFiles(x86)", "LOCALAPPDATA")]
        folders = [os.path.join(glob.escape(program), "LLVM", "bin") for program in programs if program]
        return _libraries_in([*folders, *(glob.escape(folder) for folder in os.get_exec_path())])
    roots = {sys.prefix, os.environ.get("CONDA_PREFIX") or sys.prefix}
    folders = [os.path.join(glob.escape(root), "lib") for root in sorted(roots)]
    if sys.platform == "darwin":
        for brew in ("/opt/homebrew", "/usr/local"):
            folders += [f"{brew}/opt/llvm*/lib", f"{brew}/Cellar/llvm*/*/lib"]
        return _libraries_in([*folders, "/opt/local/libexec/llvm-*/lib"])
    folders += ["/usr/lib", "/usr/lib64", "/usr/lib/*-linux-gnu*", "/usr/lib/llvm*/lib*", "/usr/lib64/llvm*/lib*"]
    folders += ["/usr/lib/llvm/*/lib*", "/usr/lib/wsl/lib", "/usr/local/lib", "/usr/local/lib64", "/opt/llvm*/lib"]
    return [*_libraries_of_linker(), *_libraries_in(folders)]


def _libraries_of_linker() -> list[str]:
    """List the LLVM libraries that the dynamic linker of Linux knows."""
    ldconfig = shutil.which("ldconfig") or "/sbin/ldconfig"  # sbin is not in everybody's PATH
    try:
        listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, timeout=10).stdout
    except (OSError, subprocess.TimeoutExpired):  # no glibc; the folders are searched anyway
        return []
    files = re.findall(r"=> (\S+)", listing)
    return [file for file in files if _LIBRARY.fullmatch(os.path.basename(file))]


# ------------------------------------------------------------------------------------------------------------- try LLVM

# Runs in the child: says on stdout, line by line, how far it came. ctypes tells a damaged or foreign file from a good
# one in plain words; only a version that is not known to abort reaches Dr.Jit.
_PROBE_CODE = """
import ctypes, json, sys

def say(**words):
    print(json.dumps(words), flush=True)

path, oldest = sys.argv[1], int(sys.argv[2])
try:
    library = ctypes.CDLL(path)
except OSError as error:
    say(refused="it cannot be loaded: " + str(error).replace(path + ": ", ""))
    sys.exit()
if not hasattr(library, "LLVMCreateMessage"):
    say(refused="it is not an LLVM library")
    sys.exit()
if not hasattr(library, "LLVMGetVersion"):  # came with LLVM 16
    say(refused="it is older than LLVM 16, and at least %d is needed" % oldest)
    sys.exit()
numbers = [ctypes.c_uint() for _ in range(3)]
library.LLVMGetVersion(*map(ctypes.byref, numbers))
version = [number.value for number in numbers]
say(version=version)
if version[0] < oldest:
    say(refused="it is too old: at least LLVM %d is needed" % oldest)
    sys.exit()

try:
    import drjit as dr
except ModuleNotFoundError:
    sys.exit()
from drjit.llvm import Float

x = dr.arange(Float, 64)
y = dr.minimum(x, 40.0) + dr.maximum(x, 20.0)
expected = [min(i, 40.0) + max(i, 20.0) for i in range(64)]
if list(y) != expected:
    say(refused="a kernel compiled with it computes wrong numbers")
elif list(dr.detail.llvm_version()) != version:
    say(refused="Dr.Jit loads another library instead")
else:
    say(compiled=True)
"""


def probe_llvm(path: str) -> Probe:
    """Load an LLVM library and run a small Dr.Jit kernel with it, in a process of its own.

    The verdict is kept in the user's cache folder until the library or Dr.Jit changes, so that only the first call
    costs time (about 0.3 s). Never raises for a bad library: `usable` is False and `reason` is a sentence.
    """
    if os.path.dirname(path):  # a bare name is left to the dynamic linker, as Dr.Jit leaves it
        path = os.path.abspath(path)
        if not os.path.exists(path):
            return Probe(path, False, None, "there is no such file", False)
    drjit = _package_version("drjit")
    key = _probe_key(path, drjit)
    kept = _read_cache().get(key) if key else None
    if kept:
        return Probe(path, kept["usable"], kept["version"] and tuple(kept["version"]), kept["reason"], kept["compiled"])
    probe, lasting = _try_llvm(path)
    if key and drjit and lasting:
        _write_cache(key, {name: value for name, value in asdict(probe).items() if name != "path"})
    return probe


def _try_llvm(path: str) -> tuple[Probe, bool]:
    """Try a library in a child process: the verdict, and whether another try would surely come to the same."""
    with tempfile.TemporaryDirectory(prefix="optics-probe-") as folder:
        # An empty kernel cache: a kernel from the disk would prove nothing about this compiler.
        environment = {**os.environ, LLVM_PATH: path, "DRJIT_CACHE_DIR": folder}
        command = [sys.executable, "-c", _PROBE_CODE, path, str(LLVM_OLDEST)]
        try:
            child = subprocess.run(
                command,
                capture_output=True,
                text=True,
                errors="replace",
                env=environment,
                cwd=folder,
                timeout=PROBE_SECONDS,
            )
        except subprocess.TimeoutExpired:
            return Probe(path, False, None, f"a trial did not end within {PROBE_SECONDS:g} s; try again", False), False
        except OSError as error:
            return Probe(path, False, None, f"no process could be started to try it: {error}", False), False
    said: dict = {}
    for line in child.stdout.splitlines():
        if line.startswith("{"):
            said.update(json.loads(line))
    version = tuple(said["version"]) if "version" in said else None
    if "refused" in said:
        return Probe(path, False, version, said["refused"], False), True
    if child.returncode == 0 and version:
        compiled = said.get("compiled", False)
        return Probe(path, True, version, "", compiled), compiled
    last = [line.strip() for line in child.stderr.splitlines() if line.strip()]
    message = next((line for line in last if "LLVM ERROR" in line), last[-1] if last else "it gave no message")
    end = f"signal {-child.returncode}" if child.returncode < 0 else f"exit code {child.returncode}"
    # An exit code is an exception, which may be Dr.Jit's own fault; signal 9 comes from outside, for lack of memory.
    lasting = child.returncode < 0 and child.returncode != -9
    return Probe(path, False, version, f"a process that used it ended with {end}: {message[:200]}", False), lasting


def _probe_key(path: str, drjit: str | None) -> str | None:
    """Name a verdict by all that it depends on; None where the path is a bare name."""
    if not os.path.dirname(path):
        return None
    real = os.path.realpath(path)
    stat = os.stat(real)
    code = hashlib.sha256(_PROBE_CODE.encode()).hexdigest()[:8]  # another trial is another verdict
    return "|".join(
        map(
            str,
            (real, stat.st_mtime_ns, stat.st_size, f"drjit {drjit}", platform.machine(), f"oldest {LLVM_OLDEST}", code),
        )
    )


def cache_folder() -> str:
    """Name the folder for what can be computed again, by the custom of the system; OPTICS_CACHE_DIR overrides it."""
    named = os.environ.get(CACHE_FOLDER)
    if named:
        return named
    home = os.path.expanduser("~")
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or os.path.join(home, "AppData", "Local")
    elif sys.platform == "darwin":
        base = os.path.join(home, "Library", "Caches")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or os.path.join(home, ".cache")
    return os.path.join(base, "tactile-optics")


def _cache_file() -> str:
    return os.path.join(cache_folder(), "llvm.json")


def _read_cache() -> dict:
    try:
        with open(_cache_file(), encoding="utf-8") as file:
            kept = json.load(file)
    except (OSError, ValueError):  # absent or damaged: the library is tried again
        return {}
    return kept if isinstance(kept, dict) else {}


def _write_cache(key: str, verdict: dict) -> None:
    """Keep a verdict; whole or not at all, as several processes may write at once."""
    path = key.split("|", 1)[0]
    kept = {old: value for old, value in _read_cache().items() if old.split("|", 1)[0] != path}
    kept[key] = verdict
    try:
        os.makedirs(cache_folder(), exist_ok=True)
        with tempfile.NamedTemporaryFile(
            "w", dir=cache_folder(), suffix=".tmp", delete=False, encoding="utf-8"
        ) as file:
            json.dump(kept, file, indent=1)
        os.replace(file.name, _cache_file())
    except OSError:
        pass  # a home that cannot be written to costs a quarter of a second each time, and `report` says so


# ---------------------------------------------------------------------------------------------------------- choose LLVM


def require_llvm() -> Probe:
    """Make sure that Dr.Jit will load an LLVM that works, or raise PlatformError with the command that brings one.

    Call it before the first import of `drjit` or `mitsuba`: the import is what loads LLVM. Sets DRJIT_LIBLLVM_PATH to
    the library that passed the trial, as Dr.Jit's own search may take another one. A library that the user named there
    is used or refused, never replaced. Warns (UntestedPlatform) for LLVM 17 and 18.
    """
    in_use = _llvm_in_use()
    if in_use:
        return in_use
    named = os.environ.get(LLVM_PATH)
    probe = probe_llvm(named) if named else _first_usable(find_llvm())
    if not probe.usable:
        if named:
            raise PlatformError(
                f"{LLVM_PATH} names {named}, which cannot be used: {probe.reason}. {_other_llvm(named)}"
            )
        raise PlatformError(f"{probe.reason} {install_advice()}")
    os.environ[LLVM_PATH] = probe.path
    if probe.version and probe.version[0] < LLVM_TESTED:
        warnings.warn(
            f"LLVM {version_text(probe.version)} is untested; the program is tested with LLVM {LLVM_TESTED}. "
            f"{install_advice()}",
            UntestedPlatform,
            stacklevel=2,
        )
    return probe


def _llvm_in_use() -> Probe | None:
    """Judge the LLVM that Dr.Jit has loaded already, by its version; None where Dr.Jit has not been imported."""
    drjit = sys.modules.get("drjit")
    if drjit is None or not hasattr(drjit, "detail"):
        return None
    version = tuple(drjit.detail.llvm_version())
    path = os.environ.get(LLVM_PATH) or "chosen by Dr.Jit"
    if version[0] >= LLVM_OLDEST:
        return Probe(path, True, version, "", True)
    found = f"LLVM {version_text(version)}" if version[0] > 0 else "no LLVM"
    raise PlatformError(
        f"Dr.Jit was imported before a usable LLVM was chosen, and has loaded {found} "
        f"(at least {LLVM_OLDEST} is needed). "
        f"{_other_llvm(os.environ.get(LLVM_PATH))}"
    )


def _first_usable(candidates: list[Llvm]) -> Probe:
    """Try the candidates in turn: the first that works, or an unusable one whose reason tells of all of them."""
    refused = []
    for llvm in candidates:
        if llvm.version and llvm.version[0] < LLVM_OLDEST:
            refused.append(f"LLVM {version_text(llvm.version)} ({llvm.path}) is too old")
            continue
        probe = probe_llvm(llvm.path)
        if probe.usable:
            return probe
        refused.append(f"{Probe(llvm.path, False, probe.version or llvm.version, '', False).name}: {probe.reason}")
    if not refused:
        return Probe(
            "", False, None, f"No LLVM library was found; the program needs LLVM {LLVM_OLDEST} or newer.", False
        )
    text = (
        f"No usable LLVM library was found; the program needs LLVM {LLVM_OLDEST} or newer. Found: {'; '.join(refused)}."
    )
    return Probe("", False, None, text, False)


def _other_llvm(named: str | None) -> str:
    """Say what to do instead of using the library that the user named."""
    real = named and os.path.realpath(named)
    other = _first_usable([llvm for llvm in find_llvm() if os.path.realpath(llvm.path) != real])
    if other.usable:
        command = "set" if sys.platform == "win32" else "export"
        return f"{other.name} works: run `{command} {LLVM_PATH}={other.path}`"
    return install_advice()


# --------------------------------------------------------------------------------------------------------- install LLVM

_ADVICE = {
    "Debian and Ubuntu": "sudo apt-get update && sudo apt-get install -y libllvm19",
    "Ubuntu 22.04 and older": "wget https://apt.llvm.org/llvm.sh && sudo bash llvm.sh 19",
    "Fedora": "sudo dnf install -y llvm-libs",
    "Arch": "sudo pacman -S llvm-libs",
    "macOS": "brew install llvm",
    "Windows": "winget install LLVM.LLVM",
    "conda": "conda install -c conda-forge libllvm19",
}


def install_advice() -> str:
    """Say which command installs LLVM on this machine; on a system that is not known, on all that are."""
    system = _system()
    if system:
        rootless = f" (without administrator rights: {_ADVICE['conda']})" if sys.platform == "linux" else ""
        return f"To install LLVM, run: {_ADVICE[system]}{rootless}"
    return "To install LLVM, run\n" + "\n".join(f"  {name}: {command}" for name, command in _ADVICE.items())


def _system() -> str | None:
    """Name the entry of the advice that fits this machine."""
    if sys.platform in ("darwin", "win32"):
        return {"darwin": "macOS", "win32": "Windows"}[sys.platform]
    release = {}
    try:
        with open("/etc/os-release", encoding="utf-8") as file:
            for line in file:
                name, _, value = line.strip().partition("=")
                release[name] = value.strip("\"'")
    except OSError:
        return None
    family = [release.get("ID", ""), *release.get("ID_LIKE", "").split()]
    if release.get("ID") == "ubuntu" and release.get("VERSION_ID", "99") < "24":  # its own packages end at LLVM 15
        return "Ubuntu 22.04 and older"
    for name, word in (("Debian and Ubuntu", "debian"), ("Fedora", "fedora"), ("Arch", "arch")):
        if word in family or (word == "debian" and "ubuntu" in family):
            return name
    return None


def install_llvm() -> Probe:
    """Install an LLVM with apt-get where that needs no password; PlatformError says what to run otherwise.

    Changes nothing where a usable one is there. Returns what the trial of the library came to.
    """
    present = _first_usable(find_llvm())
    if present.usable:
        return present
    refuse = PlatformError(f"{present.reason} {install_advice()}")
    apt = shutil.which("apt-get")
    if sys.platform != "linux" or not apt or LLVM_FOLDERS in os.environ:
        raise refuse
    root = [] if os.geteuid() == 0 else ["sudo", "-n"]
    if root and (not shutil.which("sudo") or subprocess.run(["sudo", "-n", "true"], capture_output=True).returncode):
        raise refuse
    quiet = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    packages = [f"libllvm{major}" for major in (LLVM_TESTED, LLVM_TESTED + 1, LLVM_TESTED - 1)]
    installs = [["install", "-y", package] for package in packages]
    # The package lists may be absent or old, as in a fresh container: after an update everything is asked once more.
    for step in [*installs, ["update"], *installs]:
        done = subprocess.run([*root, apt, *step], capture_output=True, text=True, errors="replace", env=quiet)
        if done.returncode == 0 and step != ["update"]:
            probe = _first_usable(find_llvm())
            if probe.usable:
                return probe
    last = (done.stderr.strip().splitlines() or ["no message"])[-1]
    raise PlatformError(
        f"apt-get could not install {' or '.join(packages)} ({last}). {present.reason} {install_advice()}"
    )


# --------------------------------------------------------------------------------------------------------------- report


def report() -> list[Row]:
    """Examine the machine and the installation: one row per finding, each fault with its next step. Takes seconds."""
    rows = [_python_row(), *_package_rows()]
    used, found = _llvm_rows()
    variants = _variant_rows(llvm_works=used.state != "fail")
    if used.state == "fail" and variants[0].state == "ok":
        used = used._replace(state="warn")  # the GPU variants do without LLVM
    rows += [
        used,
        found,
        *variants,
        _gpu_row(),
        Row("cores", str(_cores())),
        _memory_row(),
        _kernel_cache_row(),
        _own_cache_row(),
    ]
    return rows


def _python_row() -> Row:
    value = f"{platform.python_version()} ({sys.executable})"
    newest = ".".join(map(str, PYTHON_NEWEST))
    if sys.version_info[:2] < PYTHON_OLDEST:
        oldest = ".".join(map(str, PYTHON_OLDEST))
        advice = f"Python {oldest} or newer is needed: remove .venv, then run `make setup PYTHON=python{newest}`"
        return Row("Python", value, "fail", advice)
    if sys.version_info[:2] > PYTHON_NEWEST:
        return Row("Python", value, "warn", f"tested up to Python {newest}")
    return Row("Python", value)


def _package_rows() -> list[Row]:
    """One row for the packages that are here, and one for each that is missing or of a wrong version."""
    versions = {name: _package_version(name) for name in PACKAGES}
    advice = "run `make setup`, or install the package again with pip"
    faults = [Row(name, "not installed", "fail", advice) for name, version in versions.items() if not version]
    for name, pin in PINS.items():
        if versions[name] not in (None, pin):
            faults.append(Row(name, versions[name], "fail", f"exactly {name} {pin} is needed: {advice}"))
    here = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    return [Row("packages", here or "none", "fail" if faults else "ok"), *faults]


def _package_version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _llvm_rows() -> list[Row]:
    """The LLVM in use, or why there is none, and one row for all the libraries that were found."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UntestedPlatform)  # becomes a row instead
            probe = require_llvm()
    except PlatformError as error:
        used = Row("LLVM used", "none", "fail", str(error))
    else:
        state, advice = "ok", ""
        if not probe.compiled:
            state, advice = "warn", "it loads; whether kernels compile with it shows when Dr.Jit is installed"
        elif probe.version and probe.version[0] != LLVM_TESTED:
            advice = f"untested: its trial kernel ran well, but the program is tested with LLVM {LLVM_TESTED}"
            state = "warn" if probe.version[0] < LLVM_TESTED else "ok"
        used = Row("LLVM used", f"{version_text(probe.version)} ({probe.path})", state, advice)
    found = [f"{version_text(llvm.version)} ({llvm.path})" for llvm in find_llvm()]
    return [used, Row("LLVM found", "; ".join(found) or "none")]


# Runs in the child, as setting a variant cannot be undone and a bad driver may end the process.
_VARIANT_CODE = """
import json
import mitsuba as mi
import drjit as dr

backends = {"llvm": dr.JitBackend.LLVM, "cuda": dr.JitBackend.CUDA}
for variant in mi.variants():
    backend = backends.get(variant.split("_")[0])
    if backend is not None and dr.has_backend(backend):
        mi.set_variant(variant)
        dr.eval(mi.Float(1.0) + dr.arange(mi.Float, 4))
        print(json.dumps(variant), flush=True)
"""


def _variant_rows(llvm_works: bool) -> list[Row]:
    """The Mitsuba variants that run here; the scalar ones are refused, as they have no derivatives."""
    if not _package_version("mitsuba") or not _package_version("drjit"):
        return [Row("variants", "none: Mitsuba is not installed", "fail", "run `make setup`")]
    try:
        child = subprocess.run(
            [sys.executable, "-c", _VARIANT_CODE],
            capture_output=True,
            text=True,
            errors="replace",
            cwd=os.sep,  # `-c` looks for modules in the current folder, where captures may lie
            timeout=PROBE_SECONDS,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return [Row("variants", "unknown", "fail", f"a trial of Mitsuba did not end: {error}")]
    names = [json.loads(line) for line in child.stdout.splitlines() if line.startswith('"')]
    usable = [name for name in names if llvm_works or not name.startswith("llvm")]
    if child.returncode:
        last = (child.stderr.strip().splitlines() or ["it gave no message"])[-1]
        return [Row("variants", ", ".join(usable) or "none", "fail", f"Mitsuba stopped in a trial: {last[:300]}")]
    if not usable:
        return [Row("variants", "none", "fail", "see LLVM above; a variant also needs LLVM or an NVIDIA GPU")]
    return [Row("variants", ", ".join(usable))]


def _gpu_row() -> Row:
    """The NVIDIA GPUs; a machine without one is a good machine."""
    tool = shutil.which("nvidia-smi")
    if not tool:
        return Row("GPU", "none found (not needed)")
    query = [tool, "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    try:
        child = subprocess.run(query, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired) as error:
        return Row("GPU", "nvidia-smi did not answer", "warn", str(error))
    names = [line.strip() for line in child.stdout.splitlines() if line.strip()]
    if child.returncode or not names:
        return Row("GPU", "nvidia-smi reports no GPU", "warn", "the GPU variants need a driver of version 535 or newer")
    return Row("GPU", "; ".join(names))


def _cores() -> int:
    """Count the processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _memory_row() -> Row:
    """The memory that this process may use: the machine's, or what a container leaves of it."""
    sizes = []
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        sizes.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    try:
        with open("/sys/fs/cgroup/memory.max", encoding="ascii") as file:
            sizes.append(int(file.read()))
    except (OSError, ValueError):  # no container, or the word "max"
        pass
    if not sizes:
        return Row("memory", "unknown")
    gibibytes = min(sizes) / 2**30
    low = gibibytes < 4
    return Row(
        "memory",
        f"{gibibytes:.1f} GiB",
        "warn" if low else "ok",
        "large renders may need more than 4 GiB" if low else "",
    )


def _kernel_cache_row() -> Row:
    """Where Dr.Jit keeps compiled kernels, and whether it can."""
    if os.environ.get("DRJIT_CACHE_DIR"):
        folder = os.environ["DRJIT_CACHE_DIR"]
    elif sys.platform == "win32":
        folder = os.path.join(tempfile.gettempdir(), "drjit")
    elif os.environ.get("HOME"):
        folder = os.path.join(os.environ["HOME"], ".drjit")
    else:
        return Row("kernel cache", "none", "warn", "HOME is not set, so every run compiles again: set DRJIT_CACHE_DIR")
    return _folder_row("kernel cache", folder, "every run compiles its kernels again: set DRJIT_CACHE_DIR to a folder")


def _own_cache_row() -> Row:
    return _folder_row("cache", cache_folder(), f"every command tries LLVM again: set {CACHE_FOLDER} to a folder")


def _folder_row(name: str, folder: str, consequence: str) -> Row:
    """A cache folder with its size, and a warning where it cannot be written to."""
    parent = folder
    while not os.path.exists(parent) and os.path.dirname(parent) != parent:
        parent = os.path.dirname(parent)  # what does not exist yet is made in the nearest folder that does
    if not os.path.isdir(parent) or not os.access(parent, os.W_OK):
        return Row(name, folder, "warn", f"it cannot be written to, so {consequence} that can")
    size = 0
    if parent == folder:
        for name_in_folder in os.listdir(folder):
            try:
                size += os.path.getsize(os.path.join(folder, name_in_folder))
            except OSError:  # another process has just removed it
                continue
    return Row(name, f"{folder} ({size / 2**20:.1f} MiB)")


def report_table(rows: list[Row], width: int | None = None) -> str:
    """Lay out a report as text: name, value, and beneath it the next step; `width` None: as the terminal, 100 at
    most."""
    width = width or min(100, shutil.get_terminal_size((100, 24)).columns if sys.stdout.isatty() else 100)
    column = max(len(row.name) for row in rows) + 2
    marks = {"ok": " ", "warn": "!", "fail": "x"}
    lines = []
    for row in rows:
        text = textwrap.wrap(row.value, width - column - 2, break_on_hyphens=False, break_long_words=False) or [""]
        for paragraph in row.advice.splitlines():
            wrapped = textwrap.wrap(paragraph, width - column - 5, break_on_hyphens=False, break_long_words=False)
            text += [
                f"{'->' if paragraph == row.advice.splitlines()[0] and i == 0 else '  '} {w}"
                for i, w in enumerate(wrapped)
            ]
        for i, line in enumerate(text):
            lines.append(f"{marks[row.state] if i == 0 else ' '} {row.name if i == 0 else '':{column}}{line}".rstrip())
    return "\n".join(lines)


def report_json(rows: list[Row]) -> str:
    """Write a report for programs: {"ok": bool, "rows": [{"name", "value", "state", "advice"}]}."""
    return json.dumps({"ok": is_sound(rows), "rows": [row._asdict() for row in rows]}, indent=2)


def is_sound(rows: list[Row]) -> bool:
    """Tell whether nothing in the report stands in the way of work."""
    return all(row.state != "fail" for row in rows)


# ----------------------------------------------------------------------------------------------------------- by itself


def main(arguments: list[str] | None = None) -> int:
    """Run as a program: the report, or one of the two checks that `make setup` needs. Exit code 0 good, 1 not."""
    parser = argparse.ArgumentParser(
        prog="doctor", description="What this machine can run, and what to do about the rest."
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--json", action="store_true", help="the report for programs")
    what.add_argument("--llvm", action="store_true", help="only name the LLVM library that will be used")
    what.add_argument(
        "--prepare", action="store_true", help="check Python, and install LLVM where apt-get can without a password"
    )
    options = parser.parse_args(arguments)
    try:
        if options.llvm or options.prepare:
            python = _python_row()
            if python.state == "fail":
                raise PlatformError(f"Python {python.value}: {python.advice}")
            print((install_llvm() if options.prepare else require_llvm()).name)
            return 0
    except PlatformError as error:
        print(error, file=sys.stderr)
        return 1
    rows = report()
    print(report_json(rows) if options.json else report_table(rows))
    return 0 if is_sound(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
