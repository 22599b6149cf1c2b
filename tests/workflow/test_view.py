"""The page of `optics view`: what its server answers, held to the model, and the page itself in headless Chromium.

The study is small: six frames of 48 x 36 px with a hidden vignetting, one press of three held out.
"""

import contextlib
import http.client
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.light.rendering import RenderJob
from optics.pages.view import Kept, Server, View
from optics.scene import loader as scene
from optics.study import loop
from optics.study.record import Record, read_fit

HIDDEN = 0.4  # camera.vignetting
VIGNETTING, SIZE, POSE, ROUGHNESS = "camera.vignetting", "led.area", "gel.press_x[press-0]", "membrane.sigma"
SINGLE = 2e-6  # float32, relative: images travel in it, and are added up in it


@pytest.fixture(scope="module")
def study(tmp_path_factory, mitsuba):
    """A study of the base model: two powers, a roughness, in whose square the image is linear, and where each press
    is."""
    folder = tmp_path_factory.mktemp("view")
    loaded = scene.load("gelsight", {"width": "48", "height": "36"})
    noise, rng, frames = Noise(0.05, 1.0, 8.0, 255.0, 0.0), np.random.default_rng(0), []
    images = RenderJob(loaded, black=8.0)
    for k, (x, y, depth) in enumerate([(-2.0, 1.0, 0.4), (2.0, -1.0, 0.5), (3.0, 2.0, 0.4)]):
        for led in ("led_1", "led_3"):
            values = {
                **{f"{n}.power": float(n == led) for n in loaded.leds},
                "gel.press_x": x,
                "gel.press_y": y,
                "gel.press_depth": depth,
            }
            made = images.take({**values, "camera.exposure": 150.0, "camera.vignetting": HIDDEN})
            frames.append(
                capture_files.Frame(
                    f"p{k}-{led}",
                    noise.expose(made.camera, rng).astype(np.float32),
                    group=f"press-{k}",
                    parameters=values,
                )
            )
    captures = capture_files.write(
        capture_files.Captures(Path("."), "gelsight", frames, {"camera.exposure": 150.0}, noise),
        folder / "captures",
        bits=8,
    )
    setup = loop.Setup(
        captures=str(captures),
        free=["led_[13].power", "membrane.sigma"],
        per_group=["gel.press_x"],
        held_out=["press-2"],
        priors={"gel.press_x*": (None, 0.05)},
    )
    loop.begin(setup, folder / "study")
    return folder / "study"


@pytest.fixture(scope="module")
def model(study):
    """The same model, apart from the page's: (model, the study's values)."""
    found, model, _ = loop.take_up(study)
    return model, loop.kept(found, model)[1]


@pytest.fixture(scope="module")
def server(study):
    found = Server()
    found.view = View(study)
    thread = threading.Thread(target=found.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield found
    found.shutdown()
    thread.join()
    found.server_close()
    found.view.close()


@pytest.fixture(scope="module")
def view(server):
    return server.view


@pytest.fixture
def ask(server):
    """POST a question: (status, body, headers)."""

    def put(path, method="POST", headers=None, text=None, **question):
        connection = http.client.HTTPConnection(*server.server_address, timeout=60)
        with contextlib.closing(connection):
            body = (json.dumps(question) if text is None else text) if method == "POST" else None
            connection.request(
                method, f"/{server.token}{path}", body, {"Content-Type": "application/json", **(headers or {})}
            )
            answer = connection.getresponse()
            return answer.status, answer.read(), answer.headers

    return put


def floats(answer, shape=(36, 48, 3)):
    status, body, _ = answer
    assert status == 200, body
    return np.frombuffer(body, "<f4").reshape(-1, *shape)


def moved(model, view, **changes):
    """The model's own values with a page's changes put in."""
    found, values = model
    values = values.copy()
    for name, value in changes.items():
        values.put(view.sliders[name].variable, value)
    return found, values


@contextlib.contextmanager
def busy(view):
    """While the one thread of the model is at work on something else."""
    begun, end = threading.Event(), threading.Event()
    job = view.worker.submit(lambda: (begun.set(), end.wait(60)))
    assert begun.wait(60)
    try:
        yield
    finally:
        end.set()
        job.result(60)


# -- what the server answers -----------------------------------------------------------------------------------------
def test_the_record_names_frames_sliders_and_effects(ask, study):
    status, body, headers = ask("/study", "GET")
    record, step = json.loads(body), Record.open(study).steps[0]
    assert status == 200 and record["shape"] == [36, 48, 3] and record["channels"] == ["R", "G", "B"]
    assert [f["name"] for f in record["frames"] if f["held_out"]] == ["p2-led_1", "p2-led_3"]
    assert sum(f["chi2"] for f in record["frames"]) == pytest.approx(step["total"]["chi2"])
    sliders = {s["name"]: s for s in record["sliders"]}
    for v in step["variables"]:
        assert sliders[v["name"]]["value"] == v["value"] and sliders[v["name"]]["sd"] == pytest.approx(v["sd"])
    assert sliders[POSE]["frames"] == [0, 1] and sliders["gel.press_x[press-2]"]["frames"] == [4, 5]
    assert sliders[VIGNETTING]["effect"] == "lens-vignetting" and sliders[VIGNETTING]["sd"] is None
    effects = {e["key"]: e for e in record["effects"]}
    assert effects["led-size"]["onset"] == "secant" and "Definition" in effects["lens-vignetting"]["doc"]
    assert "default-src 'none'" in headers["Content-Security-Policy"]


def test_captures_predictions_and_errors_are_the_models(ask, model, view):
    found, values = moved(model, view, **{VIGNETTING: 0.2, POSE: -1.9})
    measured, use = floats(ask("/capture", frame=1))
    assert np.array_equal(measured, found.frames[1].image) and np.array_equal(use.astype(bool), found.usable(1))
    prediction, sd = floats(ask("/predict", frame=1, values={VIGNETTING: 0.2, POSE: -1.9}))
    expected = found.predict(values, [1])[0]
    assert np.allclose(prediction, expected, rtol=SINGLE, atol=0)
    assert np.allclose(sd**2, found.noise.variance(expected), rtol=4 * SINGLE, atol=0)
    elsewhere = floats(ask("/predict", frame=2, values={POSE: -1.9}))[0]  # of another press
    assert np.array_equal(elsewhere, floats(ask("/predict", frame=2))[0])


def test_a_tangent_is_the_slope_and_a_secant_meets_its_end(ask, model, view):
    found, values = model
    status, body, headers = ask("/derivative", frame=0, name=VIGNETTING)
    slope, h = floats((status, body, headers))[0], 1e-3
    ends = [found.predict(moved(model, view, **{VIGNETTING: v})[1], [0])[0] for v in (0.0, h, 2 * h)]
    # one-sided at the bound, of second order: what is left is h^2/3 f''', about 1e-7 of the image, and float32
    assert (
        np.allclose(slope, (4 * ends[1] - 3 * ends[0] - ends[2]) / (2 * h), rtol=1e-4, atol=1e-3)
        and headers["X-Step"] is None
    )
    status, body, headers = ask("/derivative", frame=0, name=SIZE)
    step = float(headers["X-Step"])
    assert step == view.sliders[SIZE].variable.parameter.plausible
    end = found.predict(moved(model, view, **{SIZE: step})[1], [0])[0]
    assert np.abs(end - ends[0]).max() > 0.1  # DN
    assert np.allclose(ends[0] + step * floats((status, body, headers))[0], end, rtol=0, atol=1e-4)
    assert (
        ask("/derivative", frame=0, name=SIZE, values={SIZE: 0.5})[2]["X-Step"] is None
    )  # off neutral the tangent says enough


def test_a_slider_of_another_press_does_nothing(ask):
    assert ask("/derivative", frame=2, name=POSE)[0] == 204


def test_rows_are_the_misfit_of_the_linear_prediction(ask, model, view):
    names, x = [VIGNETTING, "led_1.power"], np.array([0.1, -0.05])
    row = json.loads(ask("/rows", frame=0, names=[*names, "gel.press_x[press-1]"], values={VIGNETTING: 0.1})[1])
    assert row["names"] == names
    prediction, sd = floats(ask("/predict", frame=0, values={VIGNETTING: 0.1}))
    measured, use = floats(ask("/capture", frame=0))
    there = sum(v * floats(ask("/derivative", frame=0, name=n, values={VIGNETTING: 0.1}))[0] for n, v in zip(names, x))
    residual, use = measured - prediction - there, use.astype(bool)
    assert row["n"] == use.sum() and row["noise"] == pytest.approx(np.sum(sd[use] ** 2), rel=1e-5)
    for what, weight in (("chi2", 1 / sd), ("square", np.ones_like(sd))):
        q = row[what]
        quadratic = q["c"] - 2 * np.dot(q["b"], x) + x @ np.array(q["a"]) @ x
        assert quadratic == pytest.approx(
            np.sum((residual * weight)[use] ** 2), rel=1e-4
        )  # sums of 5000 float32 products


@pytest.mark.slow
def test_best_is_least_squares_over_the_fitted_frames(ask, view):
    """The deltas of the effect alone, and with all that the study calibrated, priors included."""
    held = {"led_1.power": 1.02 * view.sliders["led_1.power"].value}
    found = json.loads(ask("/best", names=[VIGNETTING], values=held)[1])
    residual, image = [], []
    for i in view.fitted:
        prediction, sd = floats(ask("/predict", frame=i))
        measured, use = floats(ask("/capture", frame=i))
        power, own = (
            (None if s == 204 else floats((s, b, h))[0])
            for s, b, h in (ask("/derivative", frame=i, name=n) for n in ("led_1.power", VIGNETTING))
        )
        known = 0 if power is None else 0.02 * view.sliders["led_1.power"].value * power
        use = use.astype(bool)
        residual.append(((measured - prediction - known) / sd)[use])
        image.append((own / sd)[use])
    residual, image = np.concatenate(residual), np.concatenate(image)
    assert found["values"][VIGNETTING] == pytest.approx(image @ residual / (image @ image), rel=1e-4)
    assert found["sd"][VIGNETTING] == pytest.approx(1 / np.sqrt(image @ image), rel=1e-4)
    assert found["before"] == pytest.approx(residual @ residual, rel=1e-4) and found["frames"] == 4

    everything = [VIGNETTING, *(n for n, s in view.sliders.items() if s.sd == s.sd and not s.effect)]
    there, chi2 = {}, []
    for _ in range(3):
        found = json.loads(ask("/best", names=everything, values=there, there=there)[1])
        there = found["values"]
        chi2.append(found["after"] / found["n"])
    assert abs(there[VIGNETTING] - HIDDEN) < 4 * found["sd"][VIGNETTING] < 0.1
    assert chi2[-1] == pytest.approx(1, abs=0.05)  # 20000 values: sd 0.01; and 8 bits


@pytest.mark.parametrize("name, off, mean", [(VIGNETTING, 0.1, 0.2), (ROUGHNESS, 0.01, 0.005)])
def test_a_prior_is_one_more_measurement(ask, view, monkeypatch, name, off, mean):
    """Estimate and prior meet in the mean weighted by 1/sd^2, wherever the image was linearised, in the parameter's
    coordinate u."""
    slider, p = view.sliders[name], view.sliders[name].variable.parameter
    there = slider.value + off
    question, slope = {"names": [name], "values": {}, "there": {name: there}}, p.per_coordinate(there)
    free = json.loads(ask("/best", **question)[1])
    value, sd = free["values"][name], free["sd"][name] / p.per_coordinate(free["values"][name])  # sd of u
    known = replace(slider.variable, prior=(there + mean, 0.5 * sd * slope), weight=1.0)
    monkeypatch.setitem(view.sliders, name, replace(slider, variable=known))
    found = json.loads(ask("/best", **question)[1])
    prior = p.coordinate(there) + mean / slope
    assert p.coordinate(found["values"][name]) == pytest.approx(0.2 * p.coordinate(value) + 0.8 * prior, rel=1e-4)
    assert found["sd"][name] / p.per_coordinate(found["values"][name]) == pytest.approx(sd / np.sqrt(5), rel=1e-4)
    assert found["before"] - free["before"] == pytest.approx(
        ((prior - p.coordinate(slider.value)) / (0.5 * sd)) ** 2, rel=1e-6
    )


def test_best_of_a_bounded_effect_stays_within(ask):
    found = json.loads(ask("/best", names=["membrane.ambient"], values={"led_1.power": 3.0})[1])  # too bright already
    assert found["values"]["membrane.ambient"] == 0 and found["after"] <= found["before"]


@pytest.mark.parametrize(
    "path, question, words",
    [
        (
            "/predict",
            {"frame": 0, "values": {"camera.vignettin": 1}},
            "unknown parameter of this page 'camera.vignettin'; did you mean 'camera.vignetting'?",
        ),
        (
            "/predict",
            {"frame": 0, "values": {VIGNETTING: -1}},
            "camera.vignetting = -1 is outside its bounds [0, 200]",
        ),
        ("/predict", {"frame": 0, "values": {VIGNETTING: "much"}}, "is not a number"),
        ("/predict", {"frame": 0, "values": [1]}, "values: not a table"),
        ("/predict", {"frame": 6}, "no frame 6; allowed: 0 to 5"),
        ("/predict", {"frame": "../../etc/passwd"}, "no frame '../../etc/passwd'"),
        ("/capture", {}, "no frame None"),
        ("/derivative", {"frame": 0, "name": ["x"]}, "unknown parameter of this page"),
        ("/rows", {"frame": 0, "names": "x"}, "names: not a list"),
        ("/best", {"names": []}, "nothing to solve for"),
    ],
)
def test_a_wrong_question_is_answered_with_a_sentence(ask, path, question, words):
    status, body, _ = ask(path, **question)
    assert status == 400 and words in json.loads(body)["error"]


def test_no_other_place_is_served(ask, study, server):
    for path in (
        "/../ladder.json",
        "/ladder.json",
        "/%2e%2e/ladder.json",
        "//etc/passwd",
        "/study/../../ladder.json",
        "/predict/",
        "/index.html",
    ):
        for method in ("GET", "POST"):
            status, body, _ = ask(path, method)
            assert status == 404 and b"nothing is at this place" in body, path
    assert ask("/predict", "GET")[0] == 404 and ask("/study", "POST")[0] == 404
    assert ask("/capture", text="{")[0] == 400 and ask("/capture", text="[]")[0] == 400
    port = server.server_address[1]
    for headers in (
        {"Host": f"evil.example:{port}"},
        {"Host": f"192.168.0.1:{port}"},
        {"Origin": "http://evil.example"},
        {"Content-Type": "text/plain"},
    ):
        assert ask("/write", headers=headers)[0] == 403, headers
    assert ask("/study", "GET", {"Host": "evil.example"})[0] == 403
    for path in ("/", "/study", f"/{'x' * len(server.token)}/study"):  # another user of this machine finds the port
        with contextlib.closing(http.client.HTTPConnection(*server.server_address, timeout=10)) as connection:
            connection.request("GET", path)
            answer = connection.getresponse()
            assert answer.status == 403 and server.token not in answer.read().decode()
    assert not list(study.glob("view-*.toml"))
    with contextlib.closing(http.client.HTTPConnection(*server.server_address, timeout=10)) as connection:
        connection.putrequest("POST", "/predict")
        connection.putheader("Content-Length", str(1 << 30))
        connection.endheaders()
        assert connection.getresponse().status == 413


def test_only_this_machine_is_served(server):
    assert server.server_address[0] == "127.0.0.1"
    if sys.platform == "linux":  # another address of the same machine, which a server on all addresses would answer
        with pytest.raises(OSError):
            socket.create_connection(("127.0.0.2", server.server_address[1]), timeout=5).close()


def test_a_closed_view_lets_the_present_job_end_and_does_no_other(study):
    view = View(study)
    with ThreadPoolExecutor(2) as pool:
        with busy(view):
            waiting, closing = pool.submit(view.predict, 0, {}), pool.submit(view.close)
            with pytest.raises((CancelledError, RuntimeError)):
                waiting.result(60)
            assert not closing.done()
        closing.result(60)
    with pytest.raises(RuntimeError):
        view.predict(0, {})


def test_a_plugins_mistake_is_told(ask, view, monkeypatch):
    def predict(values, frames):
        return 1 / 0

    monkeypatch.setattr(view.model, "predict", predict)
    status, body, headers = ask("/predict", frame=0, values={VIGNETTING: 0.77})
    assert (status, json.loads(body)["error"], headers["Connection"]) == (400, "division by zero", "close")


def test_images_longest_unused_are_forgotten():
    kept, image = Kept(size=250), np.zeros(25, np.float32)  # 100 bytes each
    for name in "ab":
        kept.put(name, (image, None))
    kept.get("a")
    kept.put("c", (image,))
    assert kept.get("b") is None and kept.get("a") is not None and kept.get("c") is not None


def test_written_values_are_read_by_compare(ask, optics, model, view, study):
    changes = {VIGNETTING: 0.25, POSE: -1.95}
    first, second = (json.loads(ask("/write", values=changes)[1]) for _ in range(2))
    assert [Path(f["file"]).name for f in (first, second)] == ["view-01.toml", "view-02.toml"]
    data = read_fit(first["file"])
    assert data["parameters"][VIGNETTING] == 0.25 and data["frames"]["p1-led_1"].keys() == {"gel.press_x"}
    assert data["frames"]["p0-led_1"]["gel.press_x"] == data["frames"]["p0-led_3"]["gel.press_x"] == -1.95
    command = first["command"].split()
    assert command[:2] == ["optics", "compare"] and Path(first["file"]).read_text() == first["text"]
    rows = json.loads(optics(*command[1:], "--json")[1])["rows"]
    found, values = moved(model, view, **changes)
    chi2 = [
        np.sum(((f.image - p) ** 2 / found.variance(values, i, p))[found.usable(i)])
        for i, (f, p) in enumerate(zip(found.frames, found.predict(values)))
    ]
    by_role = {row["scope"].get("role", ""): row["chi2"] for row in rows if row["scope"].keys() <= {"role"}}
    assert by_role == pytest.approx({"": sum(chi2), "fitted": sum(chi2[:4]), "held out": sum(chi2[4:])}, rel=1e-5)


def test_a_place_is_sought_once_before_its_effect_is_used(ask, view, monkeypatch):
    sought = []
    monkeypatch.setattr(loop, "seek", lambda model, values, effects, frames: sought.extend(e.key for e in effects))
    monkeypatch.setattr(view, "_sought", set())
    view._do(lambda: view._toml({SIZE: 0.3}))
    assert sought == ["led-size"]
    for _ in range(2):
        assert ask("/derivative", frame=1, name=VIGNETTING, values={SIZE: 0.31})[0] == 200
    assert sought == ["led-size", "lens-vignetting"]


def test_a_frames_name_survives_in_the_file(view, monkeypatch, tmp_path):
    names = ['dot. "quote" \\', "Größe \U0001f600", *"cdef"]
    monkeypatch.setattr(view.model, "frames", [replace(f, name=n) for f, n in zip(view.model.frames, names)])
    (tmp_path / "fit.toml").write_text(view._do(lambda: view._toml({POSE: -1.9})), encoding="utf-8")
    assert list(read_fit(tmp_path / "fit.toml")["frames"])[:2] == names[:2]


# -- the command -----------------------------------------------------------------------------------------------------
def test_what_is_no_study_is_refused_in_a_line(optics, study, tmp_path):
    Record.create(
        tmp_path / "empty", scene="gelsight", captures="x", facts={"setup": Record.open(study).ladder["facts"]["setup"]}
    )
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = taken.getsockname()[1]
        for arguments, words in (
            ((tmp_path,), "is no study: it has no ladder.json"),
            ((tmp_path / "absent",), "is no study"),
            ((tmp_path / "empty",), "the study has no step yet"),
            ((study, "--step", "3"), "--step 3: no such step"),
            ((study, "--port", port), f"--port {port}: "),
        ):
            code, out, err = optics("view", *arguments, "--no-browser")
            assert code == 2 and out == "" and words in err and len(err.splitlines()) == 1, err


@pytest.mark.slow
def test_the_command_serves_until_it_is_interrupted(study):
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # which background jobs ignore
        "from optics.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code, "view", str(study), "--no-browser"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        url = child.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:"), child.stderr.read()
        address, token = url.removeprefix("http://").rstrip("/").split("/")
        connection = http.client.HTTPConnection(address, timeout=60)
        with contextlib.closing(connection):
            connection.request("GET", f"/{token}/")
            page = connection.getresponse().read().decode()
        assert "<!doctype html>" in page and "http://" not in page and "https://" not in page  # asks nothing of others
        child.send_signal(signal.SIGINT)
        _, err = child.communicate(timeout=60)
    finally:
        child.kill()
        child.communicate()
    assert child.returncode == 0 and err.splitlines() == ["Ctrl-C ends it"]


# -- the page --------------------------------------------------------------------------------------------------------
class Chromium:
    """A headless Chromium, spoken to by its DevTools protocol over a pipe: JSON messages that end in NUL."""

    def __init__(self, program, folder):
        down, self._down = os.pipe()
        self._up, up = os.pipe()
        flags = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
            "--hide-scrollbars",
            "--remote-debugging-pipe",
            f"--user-data-dir={folder}",
            "about:blank",
        ]
        self._process = subprocess.Popen(
            ["bash", "-c", f'exec "$@" 3<&{down} 4>&{up}', "bash", program, *flags],
            pass_fds=(down, up),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(down)
        os.close(up)
        self._rest, self._number, self._session, self.errors, self.requests = b"", 0, None, [], []
        target = self.tell("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.tell("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.tell(f"{domain}.enable")
        self.size(1280, 800)

    def size(self, width, height):
        self.tell("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def tell(self, method, **parameters):
        self._number += 1
        message = {
            "id": self._number,
            "method": method,
            "params": parameters,
            **({"sessionId": self._session} if self._session else {}),
        }
        os.write(self._down, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + 60
        while True:
            answer = self._read(until)
            if answer.get("id") == self._number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]

    def _read(self, until):
        while b"\0" not in self._rest:
            assert select.select([self._up], [], [], max(0.0, until - time.monotonic()))[0], "Chromium does not answer"
            piece = os.read(self._up, 1 << 20)
            assert piece, "Chromium has ended"
            self._rest += piece
        text, _, self._rest = self._rest.partition(b"\0")
        event = json.loads(text)
        known = event.get("params", {})
        if event.get("method") == "Runtime.exceptionThrown":
            self.errors.append(known["exceptionDetails"])
        elif event.get("method") == "Log.entryAdded" and known["entry"]["level"] == "error":
            self.errors.append(known["entry"])
        elif event.get("method") == "Network.requestWillBeSent":
            self.requests.append(known["request"]["url"])
        return event

    def run(self, script):
        """What a script's value is."""
        found = self.tell("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, script, seconds=60):
        until = time.monotonic() + seconds
        while not self.run(script):
            assert time.monotonic() < until, f"{script} is still not so: {self.run('document.body.innerText')}"
            time.sleep(0.02)

    def open(self, url):
        self.tell("Page.navigate", url="about:blank")  # or a changed hash alone would not load the page again
        self.tell("Page.navigate", url=url)
        self.idle()

    def idle(self):
        """Until the page has all that it asked for, and shows a render."""
        self.wait("typeof S === 'object' && last && settled && !pumping && !asked && last.kind === 'rendered'")

    def drawn(self):
        self.run("new Promise(done => requestAnimationFrame(() => setTimeout(done)))")

    def key(self, *keys, shift=False):
        codes = {"ArrowLeft": 37, "ArrowRight": 39, "Tab": 9, "Escape": 27}
        for key in keys:
            text = key if len(key) == 1 else ""
            common = {
                "key": key,
                "modifiers": 8 if shift else 0,
                "windowsVirtualKeyCode": codes.get(key, ord(key[0].upper())),
            }
            self.tell("Input.dispatchKeyEvent", type="keyDown", **common, **({"text": text} if text else {}))
            self.tell("Input.dispatchKeyEvent", type="keyUp", **common)

    def text(self, *names):
        return [self.run(f"at('{name}').textContent") for name in names]

    def numbers(self, *names):
        return [float(text.replace("−", "-")) for text in self.text(*names)]

    def close(self):
        self._process.terminate()
        self._process.wait(30)
        os.close(self._down)
        os.close(self._up)


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None or shutil.which("bash") is None:
        pytest.skip("no Chromium on this machine")
    found = Chromium(program, tmp_path_factory.mktemp("chromium"))
    yield found
    found.close()


@pytest.fixture
def page(chromium, server):
    """The page, freshly opened."""
    chromium.errors.clear()
    chromium.requests.clear()
    chromium.server = server.url
    chromium.open(server.url)
    yield chromium
    assert chromium.errors == []
    assert all(url == "about:blank" or url.startswith((server.url, "data:")) for url in chromium.requests)


def misfit(model, frame, prediction, sd):
    """(rms in DN, chi2 per value) of a frame, in double precision."""
    found = model[0]
    use = found.usable(frame)
    residual = found.frames[frame].image.astype(float) - prediction
    return [np.sqrt(np.mean(residual[use] ** 2)), np.mean((residual / sd)[use] ** 2)]


SHOWN = 2e-3  # relative: the page shows three or four digits
VALUE = f"sliders.get('{VIGNETTING}').now"


@pytest.mark.slow
def test_an_effect_is_switched_and_slid_by_keyboard(page, model, view):
    """Filter, Tab, Space, Tab, arrows: linear while the model is busy, equal to numpy; then the render, equal to the
    model's."""
    found, values = model
    before = page.numbers("rms", "chi")
    base = found.predict(values, [0])[0]
    sd = np.sqrt(found.variance(values, 0, base))
    assert before == pytest.approx(misfit(model, 0, base, sd), rel=SHOWN)
    assert page.text("state", "which") == ["rendered: the study’s values", "The study’s own values, rendered."]

    page.key("/", *"vignetting", "Tab")
    while page.run("document.activeElement.id") != "e-lens-vignetting":
        page.key("Tab")
    page.key(" ")
    page.wait("images.size === 1 && !pumping")
    slope = next(found.derivatives(values, [view.sliders[VIGNETTING].variable], [0]))[1][VIGNETTING]
    while page.run("document.activeElement.ariaLabel") != VIGNETTING:
        page.key("Tab")
    with busy(view):
        page.key(*["ArrowRight"] * 6)
        page.drawn()
        value = page.run(VALUE)
        assert value > 0.05
        assert page.text("state")[0].startswith("linear")
        linear = misfit(model, 0, base + value * slope, sd)
        assert page.numbers("rms", "chi") == pytest.approx(linear, rel=SHOWN)
        shown = np.array(page.run("Array.from(last.prediction)")).reshape(base.shape)
        assert np.allclose(shown, base + value * slope, rtol=0, atol=1e-4 + 255 * SINGLE)
        assert page.text("which")[0] == "All 6 frames linear."
        everywhere = [
            misfit(model, i, p + value * d[VIGNETTING], np.sqrt(found.variance(values, i, p)))
            for i, (p, d) in enumerate(found.derivatives(values, [view.sliders[VIGNETTING].variable]))
        ]
        counts = [found.usable(i).sum() for i in range(6)]
        assert page.numbers("chiAll")[0] == pytest.approx(
            np.average([c for _, c in everywhere], weights=counts), rel=SHOWN
        )
    page.idle()
    _, there = moved(model, view, **{VIGNETTING: value})
    render = found.predict(there, [0])[0]
    rendered = misfit(model, 0, render, np.sqrt(found.variance(there, 0, render)))
    assert page.text("state") == ["rendered"] and page.numbers("rms", "chi") == pytest.approx(rendered, rel=SHOWN)
    assert page.numbers("bothL", "bothXL", "bothR", "bothXR") == pytest.approx([*linear, *rendered], rel=SHOWN)
    assert np.allclose(page.run("Array.from(last.prediction)"), render.ravel(), rtol=SINGLE, atol=0)

    page.tell("Input.dispatchKeyEvent", type="keyDown", key="o", text="o")
    page.drawn()
    assert page.text("state") == ["rendered: the study’s values"] and page.numbers("rms", "chi") == before
    page.tell("Input.dispatchKeyEvent", type="keyUp", key="o")
    page.drawn()
    assert page.text("state") == ["rendered"]
    page.key("a")
    page.wait("at('which').textContent === 'All 6 frames rendered.'")
    page.key("r")
    page.idle()
    assert page.run(VALUE) == 0 and page.numbers("rms", "chi") == before


def test_of_all_that_a_slider_passed_only_the_last_is_rendered(page, view):
    def renders():
        return sum(url.endswith("/predict") for url in page.requests)

    page.run("toggle('lens-vignetting', true)")
    page.idle()
    before = renders()
    with busy(view):
        page.run(f"set('{VIGNETTING}', 0.51, false)")
        page.wait("busy === 'true render'")
        page.run(f"for (const v of [0.52, 0.53, 0.54]) set('{VIGNETTING}', v, false)")
        page.drawn()
        assert page.text("state")[0].startswith("linear")
    page.idle()
    assert renders() == before + 2 and page.run(VALUE) == 0.54  # the one that was under way, and where the slider is


def test_a_slider_steps_in_its_coordinate(page, model, view):
    """In the page as in a fit: a roughness acts by its square, and levels off."""
    value, p = view.sliders[ROUGHNESS].value, view.sliders[ROUGHNESS].variable.parameter
    there = value + 0.02
    found, values = model
    base = found.predict(values, [0])[0]
    slope = next(found.derivatives(values, [view.sliders[ROUGHNESS].variable], [0]))[1][ROUGHNESS]  # per value
    page.run(f"touch('{ROUGHNESS}')")
    page.wait("images.size === 1 && !pumping")
    with busy(view):
        page.run(f"set('{ROUGHNESS}', {there})")
        page.drawn()
        shown = np.array(page.run("Array.from(last.prediction)")).reshape(base.shape)
    expected = (p.coordinate(there) - p.coordinate(value)) * p.per_coordinate(value) * slope
    assert p.squared and p.saturates < 10
    assert np.abs(expected).max() > 0.05 and np.allclose(shown - base, expected, rtol=0, atol=1e-4 + 255 * SINGLE)
    page.idle()


def test_frames_that_a_pose_leaves_alone_keep_the_studys_misfit(page, model, view):
    page.run(f"set('{POSE}', -1.8, false)")
    page.wait("at('which').textContent === '5 of 6 frames rendered, the rest linear.'")
    page.key("a")
    page.wait("at('which').textContent === 'All 6 frames rendered.'")
    found, values = moved(model, view, **{POSE: -1.8})
    chi2 = [misfit(model, i, p, np.sqrt(found.variance(values, i, p)))[1] for i, p in enumerate(found.predict(values))]
    counts = [found.usable(i).sum() for i in range(6)]
    assert page.numbers("chiAll", "chiHeld") == pytest.approx(
        [np.average(chi2, weights=counts), np.average(chi2[4:], weights=counts[4:])], rel=SHOWN
    )


def test_back_undoes_a_reset_and_a_fit(page, view):
    page.run(f"toggle('lens-vignetting', true), set('{VIGNETTING}', 0.3, false)")
    page.idle()
    page.key("R", shift=True)
    assert page.run(f"[{VALUE}, on.size]") == [0, 0]
    page.run("history.back()")
    page.wait(f"{VALUE} === 0.3 && on.has('lens-vignetting')")
    page.key("b")
    page.wait(f"at('message').textContent.startsWith('Best fit') && {VALUE} !== 0.3")
    page.run("history.back()")
    page.wait(f"{VALUE} === 0.3")
    page.idle()
    with busy(view):  # switched off while its fit is on the way: it stays off
        page.key("b")
        page.wait("busy === 'best fit'")
        page.run("toggle('lens-vignetting', false)")
    page.idle()
    assert page.run(f"[{VALUE}, on.size]") == [0, 0]


def test_images_follow_mode_wipe_channel_and_frame(page, model):
    found, values = model
    pixels = "Array.from(context.getImageData(0, 0, 48, 36).data)"

    def seen():
        page.drawn()
        return np.array(page.run(pixels)).reshape(36, 48, 4)[..., :3].astype(int)

    page.run("document.body.focus(), document.activeElement.blur()")
    page.key("1")
    capture = seen()
    white = page.run("captures.get(0).white")
    # float32 in the browser may round a half the other way: one level
    assert np.abs(capture - np.minimum(found.frames[0].image / white * 255, 255).round()).max() <= 1
    page.key("2")
    prediction = seen()
    assert np.abs(prediction - np.minimum(found.predict(values, [0])[0] / white * 255, 255).round()).max() <= 1
    page.key("3")
    assert np.array_equal(seen(), np.concatenate([capture[:, :24], prediction[:, 24:]], 1))
    page.key("ArrowRight", shift=True)
    assert np.array_equal(seen(), np.concatenate([capture[:, :29], prediction[:, 29:]], 1))
    assert (
        page.run("view.wipe") == pytest.approx(0.6) and page.run("at('divider').getAttribute('aria-valuenow')") == "60"
    )
    page.key("ArrowLeft", shift=True)
    page.key("c", "2")
    assert page.run("view.channel") == "R" and np.abs(seen() - prediction[..., :1]).max() <= 1
    page.key("c", "c", "c", "5")
    whitened = seen()
    z = (found.frames[0].image - found.predict(values, [0])[0]) / np.sqrt(
        found.variance(values, 0, found.predict(values, [0])[0])
    )
    z = np.where(found.usable(0).all(2), z.sum(2) / np.sqrt(3), 0)
    assert (whitened[z > 3][:, 0] > whitened[z > 3][:, 2]).all() and (
        whitened[z < -3][:, 2] > whitened[z < -3][:, 0]
    ).all()
    assert (np.abs(z) > 3).sum() > 10
    page.run("captures.get(0).use.fill(0, 0, 3), redraw()")  # the first pixel
    assert len(set(seen()[0, 0])) == 1 and np.array_equal(seen()[1:], whitened[1:])
    page.key(".")
    page.idle()
    assert page.run("at('frame').value") == "1" and page.run(
        "document.querySelector('.bars [aria-current=true]').textContent"
    ).startswith("p0-led_3")
    page.key(",", ",")
    page.idle()
    assert page.run("at('frame').value") == "5"  # round to the last one, which was held out
    visible = page.run(
        "[...sliders.values()].filter(s => s.name.startsWith('gel.press_x') && !s.row.hidden).map(s => s.name)"
    )
    assert visible == ["gel.press_x[press-2]"]


def test_the_best_fit_is_the_servers_and_is_written(page, ask, study):
    page.run("at('e-lens-vignetting').click()")
    page.key("b")
    page.wait("at('message').textContent.startsWith('Best fit')")
    page.idle()
    assert page.run(VALUE) == json.loads(ask("/best", names=[VIGNETTING])[1])["values"][VIGNETTING]
    for _ in range(3):
        page.key("B", shift=True)
        page.wait("!wantBest")
        page.idle()
        page.key("l")
        page.idle()
        assert page.run("shifted(0).length") == 0 and page.run(f"there['{VIGNETTING}']") == page.run(VALUE)
    assert abs(page.run(VALUE) - HIDDEN) < 0.05 and page.numbers("chi")[0] == pytest.approx(
        1, abs=0.1
    )  # 5184 values: sd 0.02, and 8 bits
    assert page.numbers("chi")[0] < 0.9 * page.numbers("chi0")[0]
    page.key("w")
    page.wait("at('written').open")
    file = Path(page.text("file")[0])
    assert file.parent == study and read_fit(file)["parameters"][VIGNETTING] == page.run(VALUE)
    assert page.text("text")[0] == file.read_text()
    page.key("Escape")
    page.key("R", shift=True)
    page.idle()
    assert page.text("which")[0] == "The study’s own values, rendered." and page.run("on.size") == 0


def test_a_secant_is_said_to_be_one_and_bad_numbers_are_refused(page):
    page.run("at('e-led-size').click()")
    page.wait(f"sliders.get('{SIZE}').note.textContent")
    assert "secant: the change over a step of 1" in page.run(f"sliders.get('{SIZE}').note.textContent")
    page.run(
        f"sliders.get('{SIZE}').number.value = -3; sliders.get('{SIZE}').number.dispatchEvent(new Event('change'))"
    )
    page.wait("at('message').textContent.includes('allowed: 0 to')")
    assert page.run(f"sliders.get('{SIZE}').now") == 0


def test_the_address_brings_a_state_back_and_names_what_is_unknown(page, server):
    page.open(
        f"{server.url}#on=lens-vignetting&camera.vignetting=0.3&frame=3&mode=residual&on=no-such-effect&camera.vignettin=1"
    )
    assert page.run(f"[{VALUE}, view.frame, view.mode, on.has('lens-vignetting')]") == [0.3, 2, "residual", True]
    assert "no-such-effect, camera.vignettin=1" in page.text("message")[0]


def test_everything_has_a_name_and_fits(page):
    """Every control can be reached and has a name; nothing is wider than the window."""
    page.run("for (const d of document.querySelectorAll('details')) d.open = true; toggle('led-size', true)")
    nameless = page.run(
        "[...document.querySelectorAll('input, button, select, [role=slider]')].filter(e => "
        "!(e.ariaLabel || e.textContent.trim() || (e.labels && [...e.labels].some(l => l.textContent.trim())) "
        "|| e.placeholder)).map(e => e.outerHTML)"
    )
    unreachable = page.run(
        "[...document.querySelectorAll('input, button, select, [role=slider]')].filter(e => e.tabIndex < 0).map(e "
        "=> e.outerHTML)"
    )
    assert nameless == [] and unreachable == []
    page.run("document.activeElement.blur()")
    page.key("?")
    assert page.run("at('keys').open")
    page.key("Escape")
    assert not page.run("at('keys').open")
    for width in (1280, 900, 400):
        page.size(width, 800)
        page.drawn()
        assert page.run("document.documentElement.scrollWidth") <= width
    page.size(1280, 800)
    page.idle()


@contextmanager
def opened(chromium, folder):
    """The page of a study in the browser, without an error in the end; gives its server."""
    found = Server()
    found.view = View(folder)
    thread = threading.Thread(target=found.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    chromium.errors.clear()
    try:
        chromium.open(found.url)
        yield found
    finally:
        found.shutdown()
        thread.join()
        found.server_close()
        found.view.close()
    assert chromium.errors == []


@pytest.mark.slow
def test_point_readings_are_drawn_as_points(chromium, mitsuba, tmp_path):
    """A bench with a leak: its linear prediction in the page is the server's, and the points move."""
    from optics.proof.makers import bench as jones

    truth = jones.Truth(
        photodiode=jones.Photodiode(gain=2.2), p1=jones.Polarizer(leak=0.02), p2=jones.Polarizer(leak=0.02)
    )
    settings = [
        {"polarizer.angle": a, "analyzer.angle": 11.25 * i, "source.power": p, "source.time": i / 9}
        for a in (0.0, 60.0)
        for p in (0.5, 1.0)
        for i in range(16)
    ]
    jones.write(tmp_path / "captures", truth, settings, Noise(0.05, 2.0, 64.0, 4095.0, 0.0), 3)
    loop.begin(loop.Setup(captures=str(tmp_path / "captures")), tmp_path / "study")
    with opened(chromium, tmp_path / "study") as found:
        assert chromium.run("S.shape === null && canvas.width > 300") and chromium.text("state") == [
            "rendered: the study’s values"
        ]
        image = (
            "context.getImageData(0, 0, canvas.width, canvas.height).data.reduce((a, b) => (31 * a + b) % 1000003, 0)"
        )
        before = chromium.run(image)
        chromium.run("at('e-extinction-leak').click()")
        chromium.key("b")
        chromium.wait("at('message').textContent.startsWith('Best fit')")
        chromium.idle()
        (prediction, _) = found.view.predict(
            0, {"polarizer_film.leak": chromium.run("sliders.get('polarizer_film.leak').now")}
        )
        assert (
            np.array_equal(chromium.run("Array.from(last.prediction)"), prediction.ravel())
            and chromium.run(image) != before
        )
        assert chromium.numbers("chi")[0] < 0.2 * chromium.numbers("chi0")[0]
        for key in "12345":
            chromium.key(key)
            chromium.drawn()


@pytest.mark.slow
def test_each_analyser_of_a_mosaic_is_an_image_of_its_own(chromium, mitsuba, tmp_path):
    """The page shows the pixels of each analyser together, and counts, predicts and reads out as before."""
    loaded = scene.load("polarization_camera", {"width": "50", "height": "36"})
    rng, noise, frames = np.random.default_rng(4), Noise(0.05, 1.0, 8.0, 4095.0, 0.0), []
    for name, q in (("a", 0.6), ("b", -0.4), ("c", 0.2)):
        values = {"panel.dop_q": q, "panel.dop_u_1": 0.3}
        made = RenderJob(loaded, black=8.0).take({**values, "camera.exposure": 8.0})
        frames.append(capture_files.Frame(name, noise.expose(made.camera, rng).astype(np.float32), parameters=values))
    sensor = {"width": "50", "height": "36"}
    own = capture_files.Captures(
        Path("."), "polarization_camera", frames, {"camera.exposure": 8.0}, noise, mosaic=loaded.camera.mosaic
    )
    capture_files.write(own, tmp_path / "captures", bits=16)
    loop.begin(loop.Setup(captures=str(tmp_path / "captures"), defines=sensor), tmp_path / "study")
    with opened(chromium, tmp_path / "study") as found:
        image, _ = found.view.capture(0)
        rows, columns = np.array(loaded.camera.mosaic).shape
        chromium.key("1")
        chromium.drawn()
        seen = np.array(chromium.run("Array.from(context.getImageData(0, 0, canvas.width, canvas.height).data)"))
        seen = seen.reshape(*found.view.record()["shown"], 4)
        white = chromium.run("ranges(0).white")
        height, width = 36 // rows, 50 // columns
        for i, j in np.ndindex(rows, columns):  # a seam of 50 / 48 px, rounded up, between two
            own = seen[i * (height + 2) : i * (height + 2) + height, j * (width + 2) : j * (width + 2) + width]
            expected = np.clip(image[i::rows, j::columns, 0] * 255 / white, 0, 255)
            assert np.abs(own[..., 0] - expected).max() <= 1 and (own[..., 3] == 255).all()  # whole numbers
        assert (seen[height : height + 2, :, 3] == 0).all() and (seen[:, width : width + 2, 3] == 0).all()
        assert chromium.run("at('mosaic').textContent").startswith("each analyser of the mosaic is an image of its own")
        chromium.run(
            "(() => { const box = at('panel-image').getBoundingClientRect(); at('panel-image').dispatchEvent(new "
            "PointerEvent('pointermove', { clientX: box.right - 1, clientY: box.top + 1, bubbles: true })); })()"
        )
        said = chromium.run("at('readout').textContent")
        angle = loaded.camera.mosaic[0][-1]
        assert said.startswith(f"row 0, column {50 - 1}, {angle:g}\u00b0: {image[0, 49, 0]:.0f} DN")
        assert chromium.numbers("chi")[0] < 2
