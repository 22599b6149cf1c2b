"""Stock materials that lose polarization without a word are named when a scene has polarizers."""

import warnings

import pytest

from optics.scene import loader as scenes

WINDOW = """
    <shape type="rectangle" id="extra">
        <transform name="to_world"><translate z="20"/></transform>
        {bsdf}
    </shape>
</scene>"""


def bench_with(tmp_path, bsdf):
    text = scenes.find("polarizer_bench").read_text(encoding="utf-8")
    path = tmp_path / "bench.xml"
    path.write_text(text.replace("</scene>", WINDOW.format(bsdf=bsdf)), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "bsdf, name",
    [
        ('<bsdf type="thindielectric"/>', "ThinDielectric"),
        ('<bsdf type="principled"/>', "Principled"),
        ('<bsdf type="twosided"><bsdf type="roughplastic"/></bsdf>', "RoughPlastic"),
        ('<bsdf type="mask"><bsdf type="roughdielectric"/></bsdf>', "RoughDielectric"),
    ],
)
def test_a_depolarizing_material_is_named(bsdf, name, tmp_path):
    with pytest.warns(UserWarning, match=f"'{name}' of the shape 'extra' takes all polarization"):
        scenes.load(bench_with(tmp_path, bsdf))


@pytest.mark.parametrize(
    "bsdf", ['<bsdf type="dielectric"/>', '<bsdf type="rough_interface" id="pane"/>', '<bsdf type="diffuse"/>']
)
def test_what_keeps_polarization_or_is_opaque_is_not(bsdf, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scenes.load(bench_with(tmp_path, bsdf))


def test_without_polarizers_nothing_is_said(tmp_path):
    text = scenes.find("gelsight").read_text(encoding="utf-8")
    path = tmp_path / "gelsight.xml"
    path.write_text(text.replace("</scene>", WINDOW.format(bsdf='<bsdf type="plastic"/>')), encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scenes.load(path)
