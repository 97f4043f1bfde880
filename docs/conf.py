"""The documentation site: `make docs` builds it, without a network, and takes every warning for an error."""

import importlib
import os
import pkgutil
import re
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "src"))
os.environ["NUMBA_DISABLE_JIT"] = "1"  # compiled functions then have signatures and docstrings like others

from docutils.nodes import SkipNode  # noqa: E402
from latex2mathml.converter import convert as mathml  # noqa: E402

import porrima  # noqa: E402
from porrima.bibliography import bibliography  # noqa: E402

for module in pkgutil.iter_modules(porrima.__path__):
    importlib.import_module(f"porrima.{module.name}")
del os.environ["NUMBA_DISABLE_JIT"]  # the tutorials run compiled

KEYS = set(re.findall(r"^@\w+\{(\w+),", (HERE / "references.bib").read_text(encoding="utf-8"), re.M))
DOCUMENTS = ("contributing", "vision", "changelog")

project, author = "Porrima", "The Porrima developers"
version = release = porrima.__version__

# Of the tutorials: where `porrima` is, how wide its tables are, which Python runs.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
os.environ["COLUMNS"] = "116"
os.environ["PYTHONPATH"] = str(HERE.parent / "src")
os.environ["JUPYTER_PREFER_ENV_PATH"] = "1"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
templates_path = ["templates"]
exclude_patterns = ["static", "templates"]
suppress_warnings = ["toc.not_readable"]  # a page of the index that is not there is passed over

myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 4
myst_dmath_double_inline = True

nb_execution_mode = "cache"  # a tutorial runs again when its cells change
nb_execution_in_temp = True
nb_merge_streams = True
nb_execution_cache_path = str(HERE.parent / "build" / "tutorials")
nb_execution_timeout = 120
nb_execution_raise_on_error = True
nb_execution_show_tb = True

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give types, with the shapes of arrays
napoleon_google_docstring = False
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"Porrima {release}"
html_copy_source = False
html_show_copyright = False
html_static_path = ["static"]
html_css_files = ["site.css"]
html_theme_options = {"light_css_variables": {"code-font-size": "0.76em"}}
html_math_renderer = "mathml"
pygments_style, pygments_dark_style = "friendly", "monokai"


def prepare_docstring(app, what, name, obj, options, lines):
    """Keys under "References" lead to the page of references; a colon in the line of a constant is no type."""
    if what in ("attribute", "data", "property"):
        lines[0] = lines[0].replace(": ", " – ")  # napoleon takes what stands before a colon for a type
    if "References" in lines:
        first = lines.index("References")
        for k in range(first, len(lines)):
            lines[k] = re.sub(r"\b[A-Z][A-Za-z]*\d{2,4}[a-z]?\b", _linked, lines[k])


def _linked(match):
    return f":ref:`{match[0]} <{match[0].lower()}>`" if match[0] in KEYS else match[0]


def document_where_it_is_made(app, what, name, obj, skip, options):
    """What a module hands on from another has its place there; a configuration's own settings have none."""
    if name == "model_config":
        return True
    here = app.env.current_document.autodoc_module
    there = getattr(obj, "__module__", None)
    return True if what == "module" and there and there.startswith("porrima.") and there != here else None


def write_pages(app):
    """Pages made of files that stand elsewhere: the references, and what is beside the README."""
    folder = HERE / "generated"
    folder.mkdir(exist_ok=True)
    parts = ["# References\n\nAs BibTeX: {download}`references.bib <../references.bib>`.\n"]
    for one in bibliography(KEYS):
        line = f"{one.line} [{one.address.split('//')[1]}]({one.address})" if one.address else one.line
        parts.append(f"({one.key.lower()})=\n**{one.key}**: {line}\n")
    pages = {"references": "\n".join(parts)}
    for name in DOCUMENTS:
        text = (HERE.parent / f"{name.upper()}.md").read_text(encoding="utf-8")
        text = text.replace("](docs/references.bib)", "](references.md)").replace("](docs/", "](../")
        text = text.replace("](README.md)", "](../index.md)")
        pages[name] = re.sub(r"\]\(([A-Z]+)\.md\)", lambda found: f"]({found[1].lower()}.md)", text)
    for name, text in pages.items():
        page = folder / f"{name}.md"
        if not page.is_file() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def inline_equation(writer, node):
    """An equation within a line, as MathML: no script and no network is needed to read it."""
    writer.body.append(mathml(node.astext()))
    raise SkipNode


def displayed_equation(writer, node):
    """An equation on its own."""
    writer.body.append(f'<div class="math">{mathml(node.astext(), display="block")}</div>')
    raise SkipNode


def setup(app):
    """Connect the hooks."""
    app.add_html_math_renderer("mathml", (inline_equation, None), (displayed_equation, None))
    app.connect("autodoc-process-docstring", prepare_docstring, priority=100)
    app.connect("autodoc-skip-member", document_where_it_is_made)
    app.connect("builder-inited", write_pages, priority=100)
