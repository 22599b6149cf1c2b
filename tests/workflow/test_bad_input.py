"""Wrong input is refused in one line that names it, before anything is written.

Every case is a command line. It must end with exit code 2, say exactly one line on stderr, which matches the pattern
given here (the thing, where it stands, what is allowed or what to do), show no traceback, print nothing on stdout, and
leave every file as it was."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from optics.cli import main
from optics.scene import loader as scene

NOISE = "[noise]\nsystem_gain = 0.05\ndark_noise = 1.0\nblack_level = 8.0\nsaturation = 255.0\nprnu = 0.0\n"
JOB = 'scene = "small.xml"\nout = "{out}"\ncount = 2\n'
SIZE = (48, 36)  # px, width and height: the smallest that keeps every region of an image


def small(text):
    """The GelSight-type scene at the size of these tests."""
    for name, old, new in (("width", 320, SIZE[0]), ("height", 240, SIZE[1])):
        text = text.replace(f'name="{name}" value="{old}"', f'name="{name}" value="{new}"')
    return text


def sensor_of(text):
    return re.search(r"<sensor.*?</sensor>", text, re.DOTALL)[0]


def broken_scenes(good):
    """Name -> XML, each wrong in one way."""
    sigma = '<float name="sigma" value="0.2"/>'
    return {
        "torn": good.replace("</scene>", ""),
        "prose": "hello",
        "empty": "",
        "type": good.replace('type="membrane"', 'type="membrain"'),
        "property": good.replace(sigma, sigma.replace("sigma", "sigmma")),
        "word": good.replace(sigma, sigma.replace("0.2", "rough")),
        "bounds": good.replace(sigma, sigma.replace("0.2", "9")),
        "nan": good.replace(sigma, sigma.replace("0.2", "nan")),
        "twins": good.replace('id="led_2"', 'id="led_1"'),
        "escape": good.replace('id="led_2"', 'id="../../led_2"'),
        "line": good.replace('id="led_2"', 'id="led&#10;_2"'),
        "long": good.replace('id="led_2"', f'id="{200 * "x"}"'),
        "cameras": good.replace("</scene>", sensor_of(good).replace('id="camera"', 'id="second"') + "</scene>"),
        "blind": good.replace(sensor_of(good), ""),
        "dark": re.sub(r"<emitter.*?</emitter>", "", good, flags=re.DOTALL),
        "reference": good.replace('<ref id="membrane"/>', '<ref id="membran"/>'),
        "texture": good.replace(
            sigma,
            sigma + '<texture type="bitmap" name="reflectance"><string name="filename" value="absent.png"/></texture>',
        ),
        "mesh": good.replace(
            "</scene>", '<shape type="ply"><string name="filename" value="absent.ply"/></shape></scene>'
        ),
        "sensitivity": good.replace('name="sensitivity" value="identity"', 'name="sensitivity" value="Nikon 5100"'),
        "bands": good.replace("610, 540, 460", "610, 570, 540, 500, 460"),
        "band": good.replace("610, 540, 460", "610, green"),
        "axis": good.replace(
            '<point name="target" x="0" y="0" z="0"/>', '<point name="target" x="11" y="0" z="-5"/>', 1
        ),
        "bench": re.sub(r'<default name="(width|height)".*', "", good).replace("$width", "20").replace("$height", "20"),
    }


PLUGINS = {
    "syntax": ("bad.py", "effect = Effect(\n"),
    "nothing": ("bad.py", "x = 1\n"),
    "raises": ("bad.py", "import no_such_package\n"),
    "kind": ("led.py", "from optics.scene.declare import Part\npart = Part('led', 'emitter', (), lambda: None)\n"),
    "category": ("lamp.py", "from optics.scene.declare import Part\npart = Part('lamp', 'light', (), lambda: None)\n"),
    "neutral": (
        "bad.py",
        "from optics.scene.declare import Effect\nfrom optics.scene.parameter import Parameter\n"
        "effect = Effect('rust', 'camera', (Parameter('rust', '1', 0.0),))\n",
    ),
    "part": (
        "bad.py",
        "from optics.scene.declare import Effect\nfrom optics.scene.parameter import Parameter\n"
        "effect = Effect('rust', 'hinge', (Parameter('rust', '1', 0.0, neutral=0.0),))\n",
    ),
    "stage": (
        "bad.py",
        "from optics.scene.declare import Effect\nfrom optics.scene.parameter import Parameter\n"
        "effect = Effect('rust', 'camera', (Parameter('rust', '1', 0.0, neutral=0.0),), {'emission': abs})\n",
    ),
    "twice": (
        "bad.py",
        "from optics.scene.declare import Effect\nfrom optics.scene.parameter import Parameter\n"
        "effect = Effect('rust', 'camera', (Parameter('k1', '1', 0.0, neutral=0.0),))\n",
    ),
}

DRAW = '[sample]\n"gel.press_x" = {{ {} }}\n'
JOBS = {
    "toml": "scene = small.xml\n",
    "key": JOB + 'lihgts = "each"\n',
    "missing": 'scene = "small.xml"\ncount = 2\n',
    "negative": JOB.replace("2", "-3"),
    "fraction": JOB.replace("2", "2.5"),
    "text": JOB.replace("2", '"2"'),
    "endless": JOB.replace("count = 2\n", ""),
    "output": JOB + 'outputs = ["jpg"]\n',
    "none": JOB + "outputs = []\n",
    "seed": JOB + "seed = -1\n",
    "lights": JOB + 'lights = "some"\n',
    "noise": JOB + 'outputs = ["dn"]\n',
    "camera": JOB + NOISE.replace("system_gain = 0.05", "system_gain = 0.0"),
    "dark": JOB + "[noise]\nprnu = 0.0\n",
    "define": JOB + "[defines]\nwidht = 20\n",
    "fixed": JOB + '[parameters]\n"gel.press_z" = 1\n',
    "quoted": JOB + '[parameters]\n"gel.press_x" = "1.0"\n',
    "unquoted": JOB + "[parameters]\ngel.press_x = 1\n",
    "both": JOB + '[parameters]\n"gel.press_x" = 1\n' + DRAW.format("uniform = [0, 1]"),
    "unquoted_sample": JOB + "[sample]\ngel.press_x = { uniform = [0, 1] }\n",
    "sample": JOB + '[sample]\n"gel.press_z" = { uniform = [0, 1] }\n',
    "shape": JOB + DRAW.format("unifrom = [0, 1]"),
    "two": JOB + DRAW.format("uniform = [0, 1], grid = [1]"),
    "turned": JOB + DRAW.format("uniform = [1, 0]"),
    "one": JOB + DRAW.format("uniform = [1]"),
    "log": JOB + DRAW.format("log_uniform = [0, 1]"),
    "sd": JOB + DRAW.format("normal = [0, 0]"),
    "infinite": JOB + DRAW.format("uniform = [0, inf]"),
    "beyond": JOB + DRAW.format("uniform = [0, 900]"),
    "tail": JOB.replace("2", "50") + '[sample]\n"membrane.rho_r" = { normal = [0.1, 0.1] }\n',
    "wordless": JOB + '[sample]\n"gel.indenter" = { uniform = [0, 1] }\n',
    "choice": JOB + '[sample]\n"gel.indenter" = { choice = ["ball"] }\n',
    "scene": JOB.replace("small.xml", "absent.xml"),
    "foreign": JOB.replace("{out}", "foreign"),
    "file": JOB.replace("{out}", "small.xml/x"),
}

BENCH = 'scene = "polarizer_bench"\n' + NOISE
TABLE = '[table]\nfile = "{}.csv"\nvalues = ["reading"]\n'
READINGS = {
    "volts": "analyzer.angle,reading\n" + "".join(f"{a},{0.1 + a / 100}\n" for a in range(0, 180, 20)),
    "column": "angle,reading\n" + "".join(f"{a},{20 + a}\n" for a in range(0, 180, 20)),
    "semicolons": "analyzer.angle;reading\n0;12,5\n20;13,5\n",
}


def capture_sets(folder):
    """Name -> captures.toml; the images stand beside each."""
    frames = "".join(f'[[frames]]\nimage = "{name}.png"\ngroup = "{name}"\n' for name in ("a", "b"))
    head = f'scene = "{folder / "small.xml"}"\n'
    return {
        "good": head + NOISE + frames,
        "toml": "scene = small\n",
        "key": head + NOISE.replace("[noise]", "[niose]") + frames,
        "absent": head + NOISE + frames.replace("b.png", "c.png"),
        "sizes": head + NOISE + frames.replace("b.png", "small.png"),
        "nan": head + NOISE + frames.replace("a.png", "nan.npy"),
        "white": head + NOISE + frames.replace("b.png", "white.png"),
        "jpeg": head + NOISE + frames.replace("b.png", "b.jpg"),
        "mask": head + NOISE + frames + 'mask = "black.png"\n',
        "photo": head + NOISE + frames.replace("b.png", "photo.png"),
        "setting": head + NOISE + frames + '[frames.parameters]\n"led_7.power" = 1.0\n',
        "quoted": head + NOISE + frames + '[frames.parameters]\n"led_1.power" = "1.0"\n',
        "gain": head + NOISE.replace("system_gain = 0.05", "system_gain = 1e308") + frames,
        "beyond": head + NOISE + frames + '[frames.parameters]\n"gel.press_depth" = -1.0\n',
        "silent": head + frames,
        "half": head + NOISE.replace("prnu = 0.0\n", "") + frames,
        "sunk": head + NOISE + frames.replace("b.png", "black.png"),
        "sceneless": NOISE + frames,
        "elsewhere": head.replace("small.xml", "absent.xml") + NOISE + frames,
        "size": head.replace("small.xml", "bench.xml") + NOISE + frames,
        "dark": head.replace("small.xml", "dark.xml") + NOISE + frames,
        "single": head + NOISE + frames.split('[[frames]]\nimage = "b')[0],
        "black": head
        + NOISE.replace("8.0", "0.0")
        + frames.replace("a.png", "black.png").replace("b.png", "black2.png"),
        "gray": head + NOISE + frames.replace("a.png", "gray.png").split('[[frames]]\nimage = "b')[0],
        "volts": BENCH + TABLE.format("volts"),
        "column": BENCH + TABLE.format("column"),
        "semicolons": BENCH + TABLE.format("semicolons"),
        "columns": BENCH + TABLE.format("column").replace('["reading"]', '["reading", "angle"]'),
    }


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """One folder with all that is wrong; every test must leave it as it is."""
    folder = tmp_path_factory.mktemp("bad")
    good = small(scene.find("gelsight").read_text(encoding="utf-8"))
    (folder / "small.xml").write_text(good, encoding="utf-8")
    for name, text in broken_scenes(good).items():
        (folder / f"{name}.xml").write_text(text, encoding="utf-8")
    (folder / "wide.xml").write_text(good, encoding="utf-16")
    (folder / "wide.toml").write_text(JOB, encoding="utf-16")
    (folder / "folder.xml").mkdir()
    (folder / "captures" / "folder" / "captures.toml").mkdir(parents=True)
    for name, (file, text) in PLUGINS.items():
        (folder / "plugins_" / name).mkdir(parents=True)
        (folder / "plugins_" / name / file).write_text(text, encoding="utf-8")
    for name, text in JOBS.items():
        (folder / f"{name}.toml").write_text(text.replace("{out}", f"out_{name}"), encoding="utf-8")
    for name in ("foreign", "taken"):
        (folder / name).mkdir()
        (folder / name / "thesis.txt").write_text("years of work")
    (folder / "old.exr").write_text("an earlier image")
    (folder / "other.json").write_text("somebody's notes")
    rng = np.random.default_rng(0)
    for name, text in capture_sets(folder).items():
        own = folder / "captures" / name
        own.mkdir(parents=True)
        (own / "captures.toml").write_text(text, encoding="utf-8")
        for image in ("a", "b"):
            Image.fromarray(rng.integers(60, 70, (SIZE[1], SIZE[0], 3)).astype(np.uint8)).save(own / f"{image}.png")
        Image.fromarray(np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)).save(own / "white.png")
        for image in ("black", "black2"):
            Image.fromarray(np.zeros((SIZE[1], SIZE[0], 3), np.uint8)).save(own / f"{image}.png")
        Image.fromarray(np.zeros((10, 10, 3), np.uint8)).save(own / "small.png")
        Image.fromarray(np.zeros((SIZE[1], SIZE[0], 3), np.uint8)).save(own / "photo.png", format="JPEG")
        Image.fromarray(np.full((SIZE[1], SIZE[0]), 60, np.uint8)).save(own / "gray.png")
        for table, rows in READINGS.items():
            (own / f"{table}.csv").write_text(rows)
        shutil.copy(own / "a.png", own / "b.jpg")
        np.save(own / "nan.npy", np.full((SIZE[1], SIZE[0], 3), np.nan, np.float32))
    (folder / "far.obj").write_text("v 0 0 0\nv 1e30 0 1\nv 0 1e30 1\nf 1 2 3\n")
    (folder / "fit.toml").write_text('[parameters]\n"led_9.x" = 1.0\n')
    (folder / "fit_frame.toml").write_text('[parameters]\n[frames.z]\n"gel.press_x" = 1.0\n')
    (folder / "fit_torn.toml").write_text("[parameters\n")
    return folder


def standing(folder):
    """Every file with its size and time of change."""
    return {
        p.relative_to(folder).as_posix(): (p.stat().st_size, p.stat().st_mtime_ns) if p.is_file() else None
        for p in sorted(folder.rglob("*"))
        if "__pycache__" not in p.parts
    }


RENDER = "render small.xml -o new.exr"
CALIBRATE = "calibrate captures/{} -o study"
CASES = [
    # scenes
    ("design gelsight -n 2 --effects=", r"--effects names none; allowed: names with commas between them"),
    ("params torn.xml", r"torn\.xml.*tags mismatch \(line \d+"),
    ("params prose.xml", r"prose\.xml.*failed"),
    ("params empty.xml", r"empty\.xml.*failed"),
    ("params folder.xml", r"folder\.xml: no such scene file; shipped scenes: .*gelsight"),
    ("params absent.xml", r"absent\.xml: no such scene file"),
    ("params gelsihgt", r"unknown scene 'gelsihgt'; did you mean 'gelsight'"),
    ("params type.xml", r'type\.xml: line \d+.*"membrain" not found! Did you mean \'membrane\''),
    ("params property.xml", r"property\.xml: line \d+.*sigmma.*did you mean 'sigma'"),
    ("params word.xml", r'word\.xml: line \d+.*"rough"'),
    ("params bounds.xml", r"bounds\.xml: line \d+.*membrane\.sigma = 9 rad is outside its bounds \[0, 1\.5\] rad"),
    ("params nan.xml", r"nan\.xml: line \d+.*membrane\.sigma = nan rad is not finite"),
    ("params twins.xml", r'twins\.xml: line \d+.*duplicate ID: "led_1"'),
    ("params escape.xml", r"escape\.xml: id = '\.\./\.\./led_2'; allowed: 1 to 100 characters without /"),
    ("params line.xml", r"line\.xml: id = 'led\\n_2'; allowed: 1 to 100 characters"),
    ("params long.xml", r"long\.xml: id = 'x{60}'; allowed: 1 to 100 characters"),
    ("params wide.xml", r"wide\.xml: no text in UTF-8 .*; save it as UTF-8"),
    ("params cameras.xml", r"cameras\.xml: 2 parts of the kind 'camera'; one is allowed"),
    ("params reference.xml", r"reference\.xml: line \d+.*\"membran\""),
    ("params texture.xml", r"texture\.xml: line \d+.*absent\.png"),
    ("params mesh.xml", r"mesh\.xml: line \d+.*absent\.ply"),
    ("params bands.xml", r"bands\.xml: channels as integrals need the sensitivities of .*allowed: sensitivity = "),
    ("params band.xml", r"band\.xml: line \d+.*'610, green'; allowed: wavelengths in nm"),
    ("params axis.xml", r"axis\.xml: line \d+.*led_1.*position and target are the same point"),
    ("render blind.xml -o new.exr", r"blind\.xml: (Found unused|0 cameras)"),
    ("render dark.xml -o new.exr", r"dark\.xml: no light; add an LED"),
    (
        "render sensitivity.xml -o new.exr",
        r"unknown camera sensitivity 'Nikon 5100'; did you mean 'Nikon 5100 \(NPL\)'",
    ),
    # what is said of a scene on the command line
    ("params small.xml ledd_1.x", r"small\.xml: unknown parameter 'ledd_1\.x'; did you mean 'led_1\.x'"),
    ("params small.xml -D widht=20", r"small\.xml: unknown definition 'widht'; did you mean 'width'"),
    ("params small.xml -D width=0", r"small\.xml: a camera of 0 x 36 pixels; allowed: 1 to 50,000,000"),
    (RENDER + " -D height=0", r"small\.xml: a camera of 48 x 0 pixels; allowed: 1 to 50,000,000"),
    (RENDER + " --set led_1.x=1e300", r"--set: led_1\.x = 1e\+300 mm is beyond .*; allowed: -1e\+18 to 1e\+18 mm"),
    ("compare captures/good --region conact", r"--region: unknown region 'conact'"),
    ("params small.xml -D width", r"-D width: no '='; allowed: -D NAME=VALUE"),
    ("params small.xml -D width=wide", r'small\.xml: line \d+.*"wide"'),
    ("params small.xml -D width=-20", r"small\.xml: line \d+.*-20 is out of bounds"),
    ("params small.xml -D indenter=absent.stl", r"small\.xml: line \d+.*absent\.stl: no such file"),
    ("params small.xml -D indenter=sphare", r"small\.xml: line \d+.*'sphare'; did you mean 'sphere'"),
    ("params small.xml --variant scalar_rgb", r"scalar variants are not supported; use llvm"),
    ("params small.xml --variant llvm_ad_rbg", r"unknown variant 'llvm_ad_rbg'; did you mean 'llvm_ad_rgb'"),
    ("read markers captures/good/small.png", r"good/small\.png: 10 x 10 pixels; allowed: 15 each way or more"),
    (f"{RENDER} -D indenter=far.obj", r"indenter mesh .*far\.obj: a corner 1e\+30 mm from its origin; allowed: up to"),
    (f"{RENDER} --set gel.press_z=1", r"--set: unknown parameter 'gel\.press_z'; did you mean 'gel\.press_"),
    (f"{RENDER} --set gel.press_x", r"--set gel\.press_x: no '='"),
    (f"{RENDER} --set gel.press_depth=0.5mm", r"--set: gel\.press_depth = '0\.5mm' is not a number in mm"),
    (f"{RENDER} --set gel.press_depth=-1", r"--set: gel\.press_depth = -1 mm is outside its bounds \[0, 50\] mm"),
    (f"{RENDER} --set camera.exposure=inf", r"--set: camera\.exposure = inf is not finite"),
    (f"{RENDER} --set camera.exposure=nan", r"--set: camera\.exposure = nan is not finite"),
    (f"{RENDER} --set gel.indenter=cone", r"--set: unknown choice for gel\.indenter 'cone'"),
    (f"{RENDER} --spp 0", r"spp = 0; allowed: whole numbers from 1 to"),
    (f"{RENDER} --seed=-1", r"'--seed'.*greater than or equal to 0; see `optics render --help`"),
    (f"{RENDER} --sede=1", r"--sede.*--se"),
    ("render small.xml", r"Missing option '-o'.*--help"),
    ("rendr small.xml", r"No such command 'rendr'\. Did you mean 'render'"),
    ("effects vignettign", r"unknown effect or part 'vignettign'; did you mean '.*vignetting'"),
    # where an image goes
    ("render small.xml -o old.exr", r"old\.exr exists; choose another name, or --force"),
    ("render small.xml -o other.exr", r"other\.json exists; choose another name, or --force"),
    ("render small.xml -o new.jpg", r"new\.jpg.*allowed: a name ending in \.exr"),
    ("render small.xml -o small.xml/new.exr", r"small\.xml' is a file and no folder"),
    ("render small.xml -o /proc/none/new.exr", r"/proc/none"),
    # plugins
    ("effects --plugins plugins_/syntax", r"bad\.py: SyntaxError"),
    ("effects --plugins plugins_/nothing", r"bad\.py: declares neither a part nor an effect"),
    ("effects --plugins plugins_/raises", r"bad\.py: ModuleNotFoundError.*no_such_package"),
    ("effects --plugins plugins_/kind", r"led\.py: a part of the kind 'led' exists already; choose another"),
    ("effects --plugins plugins_/category", r"lamp\.py: category 'light' is none of"),
    ("effects --plugins plugins_/neutral", r"bad\.py: parameter 'rust'.*no neutral value"),
    ("effects --plugins plugins_/part", r"bad\.py: part 'hinge' is none of"),
    ("effects --plugins plugins_/stage", r"bad\.py: stage 'emission' belongs to the part 'led'"),
    ("effects --plugins plugins_/twice", r"k1 is declared twice"),
    ("params small.xml --plugins plugins_/absent", r"absent: no such folder of plugins"),
    # jobs
    ("batch absent.toml", r"absent\.toml: no such job file"),
    ("batch toml.toml", r"toml\.toml: not valid TOML.*line 1"),
    ("batch wide.toml", r"wide\.toml: byte 0 is no UTF-8.*; save the file as UTF-8"),
    ("batch key.toml", r"key\.toml: unknown key 'lihgts'; did you mean 'lights'"),
    ("batch missing.toml", r"missing\.toml: out is missing; allowed: a folder"),
    ("batch negative.toml", r"negative\.toml: count = -3; allowed: a whole number from 1"),
    ("batch fraction.toml", r"fraction\.toml: count = 2\.5; allowed"),
    ("batch text.toml", r"text\.toml: count = '2'; allowed"),
    ("batch endless.toml", r"endless\.toml: count is missing; allowed: .* or a grid"),
    ("batch output.toml", r'output\.toml: .*outputs.*\'jpg\'; allowed: a list of "exr"'),
    ("batch none.toml", r"none\.toml: outputs = \[\]; allowed"),
    ("batch seed.toml", r"seed\.toml: seed = -1; allowed: a whole number from 0"),
    ("batch lights.toml", r"lights\.toml: lights = 'some'; allowed: \"together\" or \"each\""),
    ("batch noise.toml", r"noise\.toml: .*\"dn\", but \[noise\] is missing; give system_gain"),
    ("batch camera.toml", r"camera\.toml: \[noise\]: system_gain = 0 DN per electron; allowed: > 0"),
    ("batch dark.toml", r"dark\.toml: \[noise\] system_gain is missing; allowed: DN per electron"),
    ("batch define.toml", r"small\.xml: unknown definition 'widht'; did you mean 'width'"),
    ("batch fixed.toml", r"fixed\.toml: \[parameters\]: unknown parameter 'gel\.press_z'"),
    (
        "batch unquoted.toml",
        r"unquoted\.toml: \[parameters\]: gel is a table; a key with a dot needs quotes: \"gel\.press_x\"",
    ),
    ("batch unquoted_sample.toml", r"\[sample\]: gel is a table; a key with a dot needs quotes: \"gel\.press_x\""),
    (
        "batch quoted.toml",
        r"quoted\.toml: \[parameters\]: gel\.press_x = '1\.0' is not a number in mm; allowed: .* without quotes",
    ),
    ("batch both.toml", r"both\.toml: gel\.press_x stands in \[parameters\] and in \[sample\]"),
    ("batch sample.toml", r"sample\.toml: \[sample\]: unknown parameter 'gel\.press_z'"),
    ("batch shape.toml", r"shape\.toml: \[sample\].*'unifrom'; did you mean 'uniform'"),
    ("batch two.toml", r"two\.toml: \[sample\] gel\.press_x: uniform and grid given; allowed: exactly one"),
    ("batch turned.toml", r"gel\.press_x: uniform = \[1\.0, 0\.0\]; allowed: \[low, high\] with low < high"),
    ("batch one.toml", r"one\.toml: \[sample\] gel\.press_x.*\[1\]; allowed: \[low, high\]"),
    ("batch log.toml", r"log_uniform = \[0\.0, 1\.0\]; allowed: .*0 < low"),
    ("batch sd.toml", r"normal = \[0\.0, 0\.0\]; allowed: \[mean, standard deviation\]"),
    ("batch infinite.toml", r"infinite\.toml: \[sample\] gel\.press_x.*inf; allowed: \[low, high\]"),
    ("batch beyond.toml", r"\[sample\]: gel\.press_x = 900 mm is outside its bounds \[-500, 500\] mm"),
    ("batch tail.toml", r"\[sample\]: normal = \[0\.1, 0\.1\] draws at index \d+: membrane\.rho_r = -"),
    ("batch wordless.toml", r"gel\.indenter is a word and no number; allowed: choice or grid of sphere"),
    ("batch choice.toml", r"unknown choice for gel\.indenter 'ball'"),
    ("batch scene.toml", r"absent\.xml: no such scene file"),
    ("batch foreign.toml", r"foreign exists and holds no batch; choose another folder"),
    ("batch file.toml", r"small\.xml' is a file and no folder"),
    ("batch sample.toml --shard 0/0", r"shard '0/0'; allowed: k/n with 1 <= k <= n"),
    ("batch sample.toml --shard 5/4", r"shard '5/4'; allowed"),
    ("batch sample.toml --shard half", r"shard 'half'; allowed"),
    ("batch sample.toml --workers 0", r"workers = 0; allowed: whole numbers from 1"),
    # captures
    ("compare absent", r"absent: no such file; a capture set is a folder with captures\.toml"),
    ("compare captures/toml", r"captures\.toml: not valid TOML.*line 1"),
    ("compare captures/key", r"unknown key 'niose'; did you mean 'noise'"),
    ("compare captures/absent", r"frame 1.*'c\.png': no such file"),
    ("compare captures/sizes", r"frame 1.*\(10, 10, 3\) pixels; allowed: \(36, 48, 3\)"),
    ("compare captures/nan", r"frame 0.*NaN or infinite.*row 0"),
    ("compare captures/white", r"frame 1.*all saturated"),
    (
        "compare captures/sunk",
        r"frame 1 \('black\.png'\): half of its values are 0 DN or less, far below .* black_level = 8 DN; allowed: "
        r"2\.796 DN",
    ),
    ("compare captures/jpeg", r"frame 1.*'\.jpg' files are not read; allowed"),
    ("compare captures/photo", r"frame 1.*a JPEG by the name of \.png"),
    ("compare captures/mask", r"frame 1.*mask.*empty"),
    ("compare captures/setting", r"frame 1.*unknown parameter 'led_7\.power'; did you mean 'led_"),
    ("compare captures/quoted", r"frame 1 .*led_1\.power = '1\.0' is not a number; allowed: .* without quotes"),
    ("compare captures/gain", r"\[noise\]: system_gain = 1e\+308 .* beyond what can be computed with; allowed: up to"),
    ("compare captures/folder", r"captures\.toml: a folder, a pipe or a device; allowed: a file"),
    ("compare captures/beyond", r"frame 1.*gel\.press_depth = -1 mm is outside its bounds"),
    (
        "compare captures/silent",
        r"silent/captures\.toml: noise: no frame has repeats; add `repeats`.* or give \[noise\]",
    ),
    ("compare captures/half", r"\[noise\]: prnu .* missing; give all of"),
    ("compare captures/sceneless", r"captures\.toml: scene is missing"),
    ("compare captures/elsewhere", r"absent\.xml': no such file"),
    ("compare captures/size", r"images of 48 x 36 px, but the scene's camera has 20 x 20 px"),
    ("compare captures/dark", r"dark\.xml: the scene has no light"),
    (
        "compare captures/black",
        r"captures\.toml: none of the 10368 values of 'black\.png' \.\.\. \(0 to 0\) is usable: 10368 not above "
        r"black_level = 0 DN; allowed",
    ),
    (
        "compare captures/volts",
        r"none of the 9 values of 'volts\.csv' \(0\.1 to 1\.7\) is usable: 9 not above black_level = 8 DN; allowed: "
        r"readings above black_level, which is in their own unit",
    ),
    (
        "compare captures/column",
        r"frame 0 \('column\.csv'\): unknown parameter 'angle'.*rename = \{ \"angle\" = \"KEY\" \} under \[table\] of "
        r"captures\.toml",
    ),
    (
        "compare captures/columns",
        r"'column\.csv' has channels: 2, .*'polarizer_bench' has 1; allowed: 1, a column of `values` for each",
    ),
    (
        "compare captures/semicolons",
        r"semicolons\.csv: its cells are separated by ';', not by commas; allowed: delimiter = \";\"",
    ),
    (
        "compare captures/gray",
        r"captures\.toml: 'gray\.png' has channels: 1, .*small\.xml' has 3; allowed: 3, or one with cfa = \"RGGB\"",
    ),
    ("compare captures/good --set led_7.x=1", r"unknown parameter 'led_7\.x'"),
    ("compare captures/good --fit absent.toml", r"absent\.toml: no such file"),
    ("compare captures/good --fit fit.toml", r"fit\.toml: \[parameters\]: unknown parameter 'led_9\.x'"),
    ("compare captures/good --fit fit_frame.toml", r"fit_frame\.toml: unknown frame 'z'"),
    ("compare captures/good --fit fit_torn.toml", r"fit_torn\.toml: not valid TOML"),
    ("compare captures/good --flat-field divided", r"unknown flat-field mode 'divided'"),
    ("compare captures/good -o taken", r"taken exists and is not empty"),
    # calibration
    (CALIBRATE.format("good") + " --free led_9.*", r"unknown parameter 'led_9\.\*'"),
    (
        CALIBRATE.format("good") + " --per-group gel.presx",
        r"unknown parameter 'gel\.presx'; did you mean 'gel\.press_x'",
    ),
    (CALIBRATE.format("good") + " --prior led_1.x=11", r"--prior led_1\.x=11: allowed: PATTERN=MEAN\+-SD"),
    (CALIBRATE.format("good") + " --prior led_1.x=11+-0", r"--prior led_1\.x=11\+-0: allowed: .*SD above 0"),
    (CALIBRATE.format("good") + " --prior led_9.x=11+-1", r"free parameter for a prior 'led_9\.x'; did you mean"),
    (CALIBRATE.format("good") + " --hold-out c", r"unknown group of frames 'c'"),
    (CALIBRATE.format("good") + " --hold-out a --hold-out b", r"every group is held out; leave some"),
    (CALIBRATE.format("single") + " --hold-out a", r"every group is held out; leave some"),
    (CALIBRATE.format("good") + " --set led_1.x=left", r"led_1\.x = 'left' is not a number in mm"),
    (
        CALIBRATE.format("good") + " --free led_1.fwhm --per-group none --hold-out none",
        r"none of the 1 free parameters changes any frame: at led_1\.fwhm = 30 nm; allowed",
    ),
    (CALIBRATE.format("black"), r"none of the 10368 values .* is usable"),
    (CALIBRATE.format("good").replace("study", "taken"), r"taken exists and holds no study; choose another"),
    (CALIBRATE.format("good").replace("study", "small.xml/study"), r"small\.xml' is a file and no folder"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "expected"), CASES, ids=[c[0] for c in CASES])
def test_one_line_and_nothing_written(place, monkeypatch, capsys, arguments, expected):
    monkeypatch.chdir(place)
    before = standing(place)
    code = main(arguments.split(" "))
    said = capsys.readouterr()
    assert code == 2, said
    errors = [line for line in said.err.splitlines() if not line.startswith("warning: ")]
    assert len(errors) == 1 and errors[0].startswith("error: "), said.err
    assert re.search(expected, errors[0]), errors[0]
    assert "Traceback" not in said.err and said.out == ""
    assert standing(place) == before
    assert not Path("/proc/none").exists()


def test_a_gpu_that_is_not_there(place, monkeypatch, capsys):
    import drjit as dr

    monkeypatch.chdir(place)
    monkeypatch.setattr(dr, "has_backend", lambda backend: False)
    assert main(["params", "small.xml", "--variant", "cuda_ad_rgb"]) == 2
    said = capsys.readouterr().err
    assert "variant cuda_ad_rgb: no NVIDIA GPU that Dr.Jit can use; allowed: llvm_ad_rgb" in said, said
