# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Sphinx: the site of `make docs`, in docs/_build/html.

The documents are written to be read in the repository.  For the site, those outside docs/ and the
notebook are copied into docs/generated/, and links between documents are led to the copies.
"""

from __future__ import annotations

from html.parser import HTMLParser
import json
import os
from pathlib import Path
import re
import shutil
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.errors import SphinxError

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.writers.html5 import HTML5Translator

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
GENERATED = DOCS / 'generated'
COPIED = (
    'README.md',
    'CONTRIBUTING.md',
    'CHANGELOG.rst',
    'QUALITY_DECLARATION.md',
    'bench/README.md',
    'starcal_ros/sky/data/ATTRIBUTION.md',
)
NOTEBOOK = ROOT / 'examples/calibrate.ipynb'

project = 'starcal'
project_copyright = 'starcal maintainers'
release = ElementTree.parse(ROOT / 'package.xml').findtext('version') or ''

extensions = [
    'sphinx.ext.autodoc',
    'sphinx.ext.autosummary',
    'sphinx.ext.viewcode',
    'numpydoc',
    'myst_parser',
]
exclude_patterns = ['_build']
html_theme = 'furo'
html_title = f'starcal {release}'
html_static_path = ['static']
html_css_files = ['site.css']
highlight_language = 'none'  # a fence without a name is output of the tool
default_role = 'py:obj'

autosummary_generate = True
# True, the default, makes the pages of sources link back to names of starcal_ground that the pages
# of modules do not have.
viewcode_follow_imported_members = False
templates_path = ['templates']
autodoc_member_order = 'bysource'
autodoc_typehints = 'none'  # the signature is enough: numpydoc's sections have shapes and units
add_module_names = False
numpydoc_class_members_toctree = False
numpydoc_show_class_members = False
myst_heading_anchors = 4
myst_enable_extensions = ['amsmath', 'dollarmath']
html_math_renderer = 'mathml'


def copy_of(document: Path) -> Path:
    """Path of the copy of a document outside docs/."""
    return GENERATED / '_'.join(document.relative_to(ROOT).parts)


def led_to_copies(text: str, original: Path, shown: Path) -> str:
    """Lead the relative links of a document, written where it was, from where it is shown."""

    def lead(match: re.Match[str]) -> str:
        name, _, anchor = match[1].partition('#')
        if '://' in name or not name:
            return match[0]
        target = (original.parent / name).resolve()
        if str(target.relative_to(ROOT)) in COPIED:
            target = copy_of(target)
        path = os.path.relpath(target, shown.parent)
        return f']({path}#{anchor})' if anchor else f']({path})'

    return re.sub(r'\]\(([^)\s]+)\)', lead, text)


def notebook_page(path: Path) -> str:
    """Return the cells of a notebook as one Markdown document."""
    cells = json.loads(path.read_text())['cells']
    texts = ((cell['cell_type'], ''.join(cell['source'])) for cell in cells)
    return '\n\n'.join(
        f'```python\n{text}\n```' if kind == 'code' else text for kind, text in texts
    )


def write_copies(app: Sphinx) -> None:
    """Write the documents that are outside docs/; pages of modules that are gone go too."""
    shutil.rmtree(GENERATED, ignore_errors=True)
    GENERATED.mkdir()
    for name in COPIED:
        document, copy = ROOT / name, copy_of(ROOT / name)
        copy.write_text(led_to_copies(document.read_text(), document, copy))
    (GENERATED / 'notebook.md').write_text(notebook_page(NOTEBOOK))


def lead_links(app: Sphinx, name: str, content: list[str]) -> None:
    """Lead links of the documents in docs/ to the copies."""
    path = Path(app.env.doc2path(name))
    if path.suffix == '.md' and path.parent == DOCS:
        content[0] = led_to_copies(content[0], path, path)


def show_examples(
    app: Sphinx, what: str, name: str, module: object, options: object, lines: list[str]
) -> None:
    """Show the examples of a command, which end the help that its module has, as they are."""
    if name.startswith('starcal_ground.cli.commands.') and what == 'module':
        first = next((k for k, line in enumerate(lines) if line.startswith('  ')), len(lines))
        lines[first:first] = ['::', '']


def mathml(tex: str, is_block: bool) -> str:
    """Return an equation as MathML: browsers set it without a script and without a network."""
    known = tex.replace('{aligned}', '{align*}')  # the environment that latex2mathml has
    element: str = convert(known, display='block' if is_block else 'inline')
    return element


def write_equation(translator: HTML5Translator, node: nodes.Element) -> None:
    """Write the equation of a node."""
    translator.body.append(mathml(node.astext(), isinstance(node, nodes.math_block)))
    raise nodes.SkipNode


class Page(HTMLParser):
    """Links of an HTML page, and the anchors that links may lead to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.anchors = {''}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take the links and the anchor of a tag."""
        values = dict(attrs)
        self.links |= {values.get('href') or '', values.get('src') or ''} - {''}
        self.anchors.add(values.get('id') or '')


def broken_links(folder: Path) -> list[str]:
    """Links of the pages of a site to files or anchors of the site that do not exist."""
    root = str(folder.resolve())
    files = {str(path) for path in Path(root).rglob('*')}
    pages = {path: Page(Path(path).read_text()) for path in files if path.endswith('.html')}
    broken = []
    for path, page in pages.items():
        for link in sorted(page.links):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            name, anchor = unquote(parts.path), unquote(parts.fragment)
            target = os.path.normpath(os.path.join(os.path.dirname(path), name)) if name else path
            anchors = pages[target].anchors if target in pages else {anchor}
            if target not in files or anchor not in anchors:
                broken.append(f'{os.path.relpath(path, root)}: {link}')
    return broken


def check_links(app: Sphinx, error: Exception | None) -> None:
    """Fail if a link within the site is broken: Sphinx checks those of the documents only."""
    broken = [] if error else broken_links(Path(app.outdir))
    if broken:
        old = 'pages of an earlier site may be there: remove docs/_build first'
        raise SphinxError(
            f'{len(broken)} broken links ({old}), such as\n' + '\n'.join(broken[:10])
        )


def setup(app: Sphinx) -> None:
    """Sphinx calls this."""
    app.add_html_math_renderer('mathml', (write_equation, None), (write_equation, None))
    app.connect('autodoc-process-docstring', show_examples)
    app.connect('builder-inited', write_copies, priority=100)  # before autosummary looks for files
    app.connect('source-read', lead_links)
    app.connect('build-finished', check_links)
