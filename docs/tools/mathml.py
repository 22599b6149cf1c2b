"""Formulas as MathML, which browsers draw themselves: no script, no fonts, no network."""

from __future__ import annotations

from latex2mathml.converter import convert


def inline(self, node) -> None:
    self.body.append(convert(node.astext(), display="inline"))
    from docutils import nodes

    raise nodes.SkipNode


def block(self, node) -> None:
    self.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
    from docutils import nodes

    raise nodes.SkipNode


def setup(app) -> None:
    app.add_html_math_renderer("mathml", inline_renderers=(inline, None), block_renderers=(block, None))
