"""The doctor: finds libraries by their names, survives every bad one, remembers its verdicts, and advises in words."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from optics import doctor
from optics.doctor import Llvm, PlatformError, Probe, Row, UntestedPlatform

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def libraries(tmp_path, monkeypatch):
    """A machine with no LLVM but what a test puts into this folder, an empty cache, and no Dr.Jit loaded yet."""
    folder = tmp_path / "lib"
    folder.mkdir()
    monkeypatch.setenv(doctor.LLVM_FOLDERS, str(folder))
    monkeypatch.setenv(doctor.CACHE_FOLDER, str(tmp_path / "cache"))
    monkeypatch.setenv(doctor.LLVM_PATH, "")  # set first, so that what a test makes of it is undone
    monkeypatch.delenv(doctor.LLVM_PATH)
    monkeypatch.setattr(doctor, "_llvm_in_use", lambda: None)
    return folder


@pytest.fixture
def verdicts(monkeypatch):
    """Verdicts by file name instead of child processes: a version means usable; also the list of what was tried."""
    table, tried = {}, []

    def judge(path):
        tried.append(os.path.basename(path))
        version = table.get(os.path.basename(path))
        return Probe(path, version is not None, version, "" if version else "it is broken", version is not None), True

    monkeypatch.setattr(doctor, "_try_llvm", judge)
    monkeypatch.setattr(doctor, "_package_version", lambda name: "1.5.0")
    return table, tried


def put(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("not a library")
    return str(folder / names[0])


# find


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.so.1", (14,)),
        ("/usr/lib/llvm-14/lib/libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", (19, 1)),
        ("/usr/lib/llvm-18/lib/libLLVM.so", (18,)),
        ("/opt/homebrew/Cellar/llvm/19.1.7/lib/libLLVM.dylib", (19, 1, 7)),
        ("/opt/homebrew/opt/llvm@18/lib/libLLVM.dylib", (18,)),
        ("/usr/local/lib/libLLVM.so", None),
        ("C:/Program Files/LLVM/bin/LLVM-C.dll", None),
    ],
)
def test_version_is_read_from_the_name(path, version):
    assert doctor._version_in_name(path) == version


def test_find_takes_only_llvm_itself(libraries):
    put(
        libraries,
        "libLLVM.so.19.1",
        "libLLVMSPIRVLib.so.15",
        "libLLVMCore.a",
        "libLLVM-17-rust-1.75.so",
        "libclang.so.19",
    )
    assert doctor.find_llvm() == [Llvm(str(libraries / "libLLVM.so.19.1"), (19, 1))]


def test_find_prefers_the_tested_version_and_puts_the_old_ones_last(libraries):
    put(
        libraries,
        "libLLVM-14.so.1",
        "libLLVM-18.so",
        "libLLVM.so.19.1",
        "libLLVM.so.20.1",
        "libLLVM.so",
        "libLLVM-16.so.1",
    )
    assert [llvm.version for llvm in doctor.find_llvm()] == [(19, 1), (20, 1), (18,), None, (16,), (14,)]


def test_find_names_a_library_once(libraries):
    put(libraries, "libLLVM.so.19.1")
    (libraries / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    (libraries / "libLLVM.so").symlink_to("libLLVM-19.so")
    assert len(doctor.find_llvm()) == 1


def test_find_puts_what_the_user_named_first(libraries, monkeypatch):
    put(libraries, "libLLVM.so.19.1", "libLLVM-15.so.1")
    monkeypatch.setenv(doctor.LLVM_PATH, str(libraries / "libLLVM-15.so.1"))
    assert [llvm.version for llvm in doctor.find_llvm()] == [(15,), (19, 1)]


# try


def test_a_file_that_is_no_library_gives_a_sentence(libraries):
    probe = doctor.probe_llvm(put(libraries, "libLLVM.so.19.1"))
    assert not probe.usable and "cannot be loaded" in probe.reason


def test_an_absent_file_gives_a_sentence(libraries):
    probe = doctor.probe_llvm(str(libraries / "libLLVM.so.19.1"))
    assert not probe.usable and probe.reason == "there is no such file"


@pytest.mark.skipif(sys.platform == "win32", reason="a process ends by a signal only on POSIX")
def test_a_library_that_aborts_the_process_gives_a_sentence(libraries, monkeypatch):
    code = """
import os, sys
print('{"version": [16, 0, 6]}', flush=True)
print("LLVM ERROR: no", file=sys.stderr, flush=True)
os.abort()
"""
    monkeypatch.setattr(doctor, "_PROBE_CODE", code)
    probe = doctor.probe_llvm(put(libraries, "libLLVM-16.so.1"))
    assert not probe.usable and probe.version == (16, 0, 6)
    assert "signal 6: LLVM ERROR: no" in probe.reason


def test_a_trial_that_hangs_gives_a_sentence_and_is_not_remembered(libraries, monkeypatch):
    monkeypatch.setattr(doctor, "_PROBE_CODE", "import time; time.sleep(60)")
    monkeypatch.setattr(doctor, "PROBE_SECONDS", 0.2)
    probe = doctor.probe_llvm(put(libraries, "libLLVM.so.19.1"))
    assert not probe.usable and "did not end" in probe.reason
    assert doctor._read_cache() == {}


def test_an_exception_in_the_trial_is_not_blamed_on_the_library_for_good(libraries, monkeypatch):
    monkeypatch.setattr(doctor, "_PROBE_CODE", "raise ImportError('Dr.Jit is damaged')")
    probe = doctor.probe_llvm(put(libraries, "libLLVM.so.19.1"))
    assert not probe.usable and "Dr.Jit is damaged" in probe.reason
    assert doctor._read_cache() == {}


# remember


def test_a_verdict_is_remembered(libraries, verdicts):
    table, tried = verdicts
    table["libLLVM.so.19.1"] = (19, 1, 7)
    path = put(libraries, "libLLVM.so.19.1")
    first, second = doctor.probe_llvm(path), doctor.probe_llvm(path)
    assert first == second and first.version == (19, 1, 7)
    assert tried == ["libLLVM.so.19.1"]


def test_a_refusal_is_remembered(libraries, verdicts):
    path = put(libraries, "libLLVM.so.19.1")
    assert doctor.probe_llvm(path).reason == doctor.probe_llvm(path).reason == "it is broken"
    assert len(verdicts[1]) == 1


def replace_library(path, monkeypatch):
    os.utime(path, ns=(1, 1))


def upgrade_drjit(path, monkeypatch):
    monkeypatch.setattr(doctor, "_package_version", lambda name: "1.6.0")


def change_the_trial(path, monkeypatch):
    monkeypatch.setattr(doctor, "_PROBE_CODE", "another")


def damage_the_cache(path, monkeypatch):
    Path(doctor._cache_file()).write_text("{")


@pytest.mark.parametrize("change", [replace_library, upgrade_drjit, change_the_trial, damage_the_cache])
def test_a_verdict_is_forgotten_when_its_grounds_change(libraries, verdicts, monkeypatch, change):
    path = put(libraries, "libLLVM.so.19.1")
    doctor.probe_llvm(path)
    change(path, monkeypatch)
    doctor.probe_llvm(path)
    assert len(verdicts[1]) == 2
    assert len(doctor._read_cache()) == 1  # the old verdict leaves the file


def test_nothing_is_remembered_before_drjit_is_installed(libraries, verdicts, monkeypatch):
    monkeypatch.setattr(doctor, "_package_version", lambda name: None)
    doctor.probe_llvm(put(libraries, "libLLVM.so.19.1"))
    assert doctor._read_cache() == {}


def test_a_cache_that_cannot_be_written_costs_only_time(libraries, verdicts, tmp_path, monkeypatch):
    verdicts[0]["libLLVM.so.19.1"] = (19, 1, 7)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(doctor.CACHE_FOLDER, str(tmp_path / "file" / "cache"))
    path = put(libraries, "libLLVM.so.19.1")
    assert doctor.probe_llvm(path).usable and doctor.probe_llvm(path).usable
    assert len(verdicts[1]) == 2


# choose


def test_require_sets_the_library_that_passed(libraries, verdicts):
    verdicts[0].update({"libLLVM-15.so.1": (15, 0, 6), "libLLVM.so.20.1": (20, 1, 0)})
    put(libraries, "libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM.so.20.1")
    assert doctor.require_llvm().version == (20, 1, 0)
    assert os.environ[doctor.LLVM_PATH] == str(libraries / "libLLVM.so.20.1")
    assert verdicts[1] == ["libLLVM.so.19.1", "libLLVM.so.20.1"]  # 19 is preferred, broken here; the old are not tried


def test_require_without_any_library_names_the_command(libraries, monkeypatch):
    monkeypatch.setattr(doctor, "_system", lambda: "Fedora")
    with pytest.raises(PlatformError, match=r"No LLVM library was found.*sudo dnf install -y llvm-libs"):
        doctor.require_llvm()
    assert doctor.LLVM_PATH not in os.environ


def test_require_with_only_bad_libraries_tells_of_each(libraries, verdicts):
    put(libraries, "libLLVM-14.so.1", "libLLVM.so.19.1")
    with pytest.raises(PlatformError) as caught:
        doctor.require_llvm()
    assert "LLVM 14 " in str(caught.value) and "too old" in str(caught.value) and "it is broken" in str(caught.value)


def test_require_refuses_what_the_user_named_and_does_not_replace_it(libraries, verdicts, monkeypatch):
    verdicts[0]["libLLVM.so.19.1"] = (19, 1, 7)
    bad = put(libraries, "libLLVM-15.so.1", "libLLVM.so.19.1")
    monkeypatch.setenv(doctor.LLVM_PATH, bad)
    with pytest.raises(PlatformError, match=r"it is broken\. LLVM 19\.1\.7 .* works: run `"):
        doctor.require_llvm()
    assert os.environ[doctor.LLVM_PATH] == bad


@pytest.mark.parametrize("major", [17, 18])
def test_require_warns_of_an_untested_version(libraries, verdicts, major):
    name = f"libLLVM-{major}.so"
    verdicts[0][name] = (major, 0, 6)
    put(libraries, name)
    with pytest.warns(UntestedPlatform, match=f"LLVM {major}.0.6 is untested"):
        doctor.require_llvm()


class FakeDrjit:
    def __init__(self, *version):
        self.detail = self
        self.llvm_version = lambda: version


def test_a_library_already_loaded_is_accepted_or_refused_by_its_version(tmp_path, monkeypatch):
    monkeypatch.setenv(doctor.LLVM_FOLDERS, str(tmp_path))
    monkeypatch.setitem(sys.modules, "drjit", FakeDrjit(19, 1, 7))
    assert doctor.require_llvm().version == (19, 1, 7)
    for version, found in (((16, 0, 6), "LLVM 16.0.6"), ((-1, -1, -1), "no LLVM")):
        monkeypatch.setitem(sys.modules, "drjit", FakeDrjit(*version))
        with pytest.raises(PlatformError, match=f"imported before.*has loaded {found}"):
            doctor.require_llvm()


# install


def test_install_tries_again_after_an_update_of_the_package_lists(libraries, verdicts, monkeypatch):
    asked = []

    def run(command, **_):
        asked.append(command[-1])
        updated = "update" in asked
        if updated and command[-1] == "libllvm19":
            verdicts[0]["libLLVM.so.19.1"] = (19, 1, 7)
            put(libraries, "libLLVM.so.19.1")
        good = command[-1] == "update" or (updated and command[-1] == "libllvm19")
        return subprocess.CompletedProcess(command, 0 if good else 100, "", "E: Unable to locate package")

    monkeypatch.setattr(doctor, "_system_libraries", lambda: doctor._libraries_in([str(libraries)]))
    monkeypatch.delenv(doctor.LLVM_FOLDERS)
    monkeypatch.setattr(doctor.sys, "platform", "linux")
    monkeypatch.setattr(doctor.os, "geteuid", lambda: 0, raising=False)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: "/fake/" + name)
    monkeypatch.setattr(doctor.subprocess, "run", run)
    assert doctor.install_llvm().version == (19, 1, 7)
    assert asked == ["libllvm19", "libllvm20", "libllvm18", "update", "libllvm19"]


def test_install_leaves_the_machine_alone_where_it_may_not(libraries, verdicts, monkeypatch):
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: pytest.fail("started a process"))
    with pytest.raises(PlatformError, match="To install LLVM, run"):
        doctor.install_llvm()


def test_an_unknown_system_is_shown_every_command(monkeypatch):
    monkeypatch.setattr(doctor, "_system", lambda: None)
    for word in ("apt-get install -y libllvm19", "dnf install", "brew install llvm"):
        assert word in doctor.install_advice()


# report

ROWS = [Row("Python", "3.11.7"), Row("LLVM used", "none", "fail", "To install LLVM, run: brew install llvm")]


def test_the_table_marks_a_fault_and_puts_the_next_step_beneath():
    assert doctor.report_table(ROWS).splitlines() == [
        "  Python     3.11.7",
        "x LLVM used  none",
        "             -> To install LLVM, run: brew install llvm",
    ]


def test_the_json_report_reads_back():
    read = json.loads(doctor.report_json(ROWS))
    assert read["ok"] is False
    assert read["rows"][1]["advice"] == "To install LLVM, run: brew install llvm"


def test_llvm_is_no_fault_where_a_gpu_serves(monkeypatch):
    monkeypatch.setattr(doctor, "_llvm_rows", lambda: [ROWS[1], Row("LLVM found", "none")])
    monkeypatch.setattr(doctor, "_variant_rows", lambda llvm_works: [Row("variants", "cuda_ad_mono_polarized")])
    assert {row.name: row.state for row in doctor.report()}["LLVM used"] == "warn"


def test_a_missing_or_wrong_package_is_a_fault(monkeypatch):
    versions = {"mitsuba": "3.8.0", "rich": None}
    monkeypatch.setattr(doctor, "_package_version", lambda name: versions.get(name, doctor.PINS.get(name, "9.9")))
    faults = {row.name: row for row in doctor._package_rows()[1:]}
    assert set(faults) == {"mitsuba", "rich"}
    assert "exactly mitsuba 3.9.1" in faults["mitsuba"].advice and "make setup" in faults["rich"].advice


def test_the_packages_are_those_of_pyproject():
    needs = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    assert {name: f"{name}=={version}" in needs for name, version in doctor.PINS.items()} == dict.fromkeys(
        doctor.PINS, True
    )
    names = {need.split(";")[0].split("=")[0].rstrip("<>!~ ") for need in needs} - {
        "tomli"
    }  # tomllib before Python 3.11
    assert names == set(doctor.PACKAGES)


# by itself


def test_it_runs_before_anything_is_installed(tmp_path):
    # -S hides the installed packages, so this is a Python that has its standard library only
    command = [sys.executable, "-I", "-S", doctor.__file__, "--llvm"]
    nothing = {**os.environ, doctor.LLVM_FOLDERS: str(tmp_path), doctor.CACHE_FOLDER: str(tmp_path)}
    nothing.pop(doctor.LLVM_PATH, None)
    child = subprocess.run(command, capture_output=True, text=True, env=nothing)
    assert child.returncode == 1 and child.stdout == ""
    assert child.stderr.startswith("No LLVM library was found")


def test_this_machine_can_run_the_other_tests():
    child = subprocess.run([sys.executable, "-I", doctor.__file__, "--llvm"], capture_output=True, text=True)
    assert child.returncode == 0, child.stderr
    assert child.stdout.startswith("LLVM ")
