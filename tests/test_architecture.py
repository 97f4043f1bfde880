"""Arrows point one way, docstrings are whole, files stay small: the rules that no reviewer should have to repeat."""

import ast
import re
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "porrima"
UPSTREAM = {  # module: what it may import, anywhere in it. This table *is* the architecture diagram.
    "units": set(),
    "errors": set(),
    "files": {"errors"},
    "markdown": set(),
    "instruments": set(),
    "streams": set(),
    "moments": set(),
    "elementary": set(),
    "orbits": {"elementary"},
    "photometry": set(),
    "stars": {"units"},
    "dust": set(),
    "rows": {"errors"},
    "tables": {"errors", "rows"},
    "besancon": {"errors", "rows", "stars", "tables"},
    "trilegal": {"besancon", "errors", "rows", "stars", "tables"},
    "gaia": {"files", "errors", "photometry", "rows", "tables"},
    "catalogs": {"files", "besancon", "errors", "gaia", "rows", "stars", "tables", "trilegal"},
    "populations": {"dust", "photometry"},
    "sightlines": {"dust", "photometry", "populations", "stars"},
    "galaxy": {"dust", "photometry", "populations", "sightlines", "stars"},
    "companions": {"orbits"},
    "eccentricity": {"companions"},
    "moe": {"companions", "eccentricity", "orbits"},
    "hierarchy": {"companions"},
    "published": {"companions", "eccentricity", "hierarchy", "moe", "orbits"},
    "multiplicity": {"companions", "eccentricity", "hierarchy", "moe", "orbits", "photometry", "published"},
    "systems": {"companions", "errors", "moments", "orbits", "photometry", "selection", "stars", "units"},
    "selection": {"errors", "rows", "tables"},
    "screen": {"errors", "selection", "systems"},
    "clip": {"errors", "moments", "response", "selection", "singles"},
    "kept": {"moments", "photometry", "screen", "systems"},
    "clipping": {"clip", "errors", "integrals", "kept", "photometry", "response", "screen", "systems"},
    "spectra": set(),
    "sampling": {"units"},
    "optics": {"instruments", "sampling", "spectra"},
    "roman": {"errors", "sampling", "spectra"},
    "psf_files": {"errors"},
    "psf": {"errors", "optics", "psf_files", "roman", "sampling", "spectra"},
    "passbands": {"errors", "photometry", "roman"},
    "shapes": {"errors"},
    "stamps": {"shapes"},
    "weighted": {"moments", "shapes", "stamps"},
    "aperture": {"moments", "shapes", "weighted"},
    "cache": set(),
    "response": {"aperture", "cache", "moments", "psf", "reach", "shapes", "stamps", "weighted"},
    "reach": {"psf", "shapes"},
    "images": {"psf", "reach", "shapes", "systems"},
    "measurement": {"errors", "images", "psf", "response", "shapes", "systems"},
    "detector": {"images", "psf", "shapes", "stamps", "systems"},
    "exposure": set(),
    "pointings": {"psf"},
    "detection": {"cache", "exposure", "pointings", "psf", "selection", "units"},
    "precision": {"exposure", "pointings", "psf", "shapes", "stamps"},
    "gaia_flags": {"selection"},
    "detection_figure": {"figures"},
    "recognition": {"detection", "detection_figure", "exposure", "instruments", "io", "psf"},
    "kappa": {"files", "errors", "figures", "io", "moments", "psf", "response", "shapes"},
    "toy": {
        "errors", "figures", "files", "images", "instruments", "moments", "psf", "response", "shapes",
        "systems",
    },
    "pairs": {"elementary", "orbits", "photometry", "streams", "systems"},
    "blocks": {"elementary", "moments", "pairs"},
    "gpu": {"elementary", "errors", "moments", "pairs", "streams"},
    "triples": {"blocks", "elementary", "hierarchy", "moments", "pairs", "streams", "systems"},
    "stack": {"blocks", "errors", "gpu", "moments", "pairs", "rejection", "screen", "streams", "systems", "triples"},
    "integrals": {"companions", "kept", "moments", "orbits", "photometry", "screen", "systems"},
    "rejection": {"blocks", "elementary", "pairs", "screen", "streams", "systems"},
    "triple_averages": {"companions", "hierarchy", "moments", "photometry", "systems"},
    "averages": {"errors", "integrals", "moments", "systems", "triple_averages"},
    "singles": {"moments", "response"},
    "prediction": {"averages", "integrals", "moments", "response", "singles"},
    "distribution": {
        "averages", "errors", "integrals", "moments", "photometry", "prediction", "response", "screen", "singles",
        "systems", "triple_averages",
    },
    "uncertainty": {
        "averages", "companions", "integrals", "multiplicity", "photometry", "prediction", "response", "selection",
        "stars", "systems",
    },
    "colour": {
        "companions", "errors", "integrals", "passbands", "photometry", "psf", "psf_files", "reach", "roman", "shapes",
        "spectra", "stars", "systems",
    },
    "own_sizes": {"clip", "clipping", "prediction", "response", "screen", "singles"},
    "truncation": {"own_sizes"},
    "choice": {"instruments", "own_sizes", "prediction", "truncation"},
    "margin": {
        "choice", "clipping", "companions", "gain", "multiplicity", "own_sizes", "photometry", "response", "stars",
        "systems",
    },
    "choice_figure": {"figures"},
    "galaxies": {"errors", "units"},
    "shear": {"errors", "galaxies", "moments", "prediction", "shapes"},
    "deconvolution": {"galaxies", "moments", "psf", "shear"},
    "criteria": set(),
    "config": {"criteria", "errors", "multiplicity", "photometry"},
    "sample": {
        "catalogs", "clip", "config", "criteria", "detection", "errors", "exposure", "gaia_flags", "galaxy",
        "instruments", "psf", "response", "selection", "shapes", "stars", "systems",
    },
    "tallies": set(),
    "lock": {"errors"},
    "store": {"config", "errors", "lock", "moments", "multiplicity", "sample", "stars", "systems", "tallies"},
    "cluster": {"errors"},
    "simulation": {
        "cluster", "config", "errors", "images", "moments", "psf", "response", "sample", "shapes", "stack", "store",
        "systems", "tallies",
    },
    "summary": {"config", "prediction", "psf", "response", "shapes", "store", "systems", "tallies"},
    "resolution": {"galaxies", "psf"},
    "gain": {"averages", "companions", "integrals", "photometry", "stars", "systems", "uncertainty"},
    "correction": {"galaxies", "moments", "prediction", "psf", "response", "shapes", "shear", "uncertainty"},
    "extrapolation": {"errors"},
    "samples": {
        "averages", "companions", "distribution", "gain", "integrals", "photometry", "prediction", "response",
        "stars", "systems",
    },
    "approaches": {
        "companions", "correction", "extrapolation", "gain", "photometry", "response", "samples", "stars",
        "systems", "uncertainty",
    },
    "trials": {
        "companions", "correction", "extrapolation", "gain", "images", "photometry", "prediction", "psf",
        "response", "samples", "shapes", "stack", "stars", "systems", "uncertainty",
    },
    "patches": {"correction", "errors", "rows", "tables"},
    "shares": {"prediction", "uncertainty"},
    "budget": {
        "averages", "companions", "errors", "galaxies", "instruments", "integrals", "photometry", "prediction",
        "response", "selection", "shares", "shear", "stars", "systems", "uncertainty",
    },
    "io": {"errors", "files", "galaxies", "rows", "systems", "tables"},
    "archive": {"cache", "files"},
    "experiments": {
        "archive", "cache", "config", "multiplicity", "prediction", "psf", "response", "sample", "shapes", "simulation",
        "store", "summary", "uncertainty",
    },
    "star_experiments": {"galaxy", "multiplicity", "stars"},
    "findings": {"config", "experiments", "instruments", "toy"},
    "paper_tables": {"multiplicity", "psf", "response", "shapes"},
    "statements": {
        "averages", "config", "detector", "experiments", "gaia_flags", "galaxy", "images", "instruments", "integrals",
        "multiplicity", "photometry", "prediction", "psf", "response", "sample", "samples", "shapes", "stack", "stars",
        "systems", "toy",
    },
    "programme": {
        "archive", "cache", "config", "experiments", "findings", "instruments", "multiplicity", "paper_tables", "psf",
        "star_experiments", "statements", "toy",
    },
    "evidence": set(),
    "stack_rules": {"evidence"},
    "star_rules": {"evidence"},
    "statement_rules": {"evidence", "instruments", "stack_rules", "star_rules"},
    "claim_table": {"claims", "markdown"},
    "claims": {"archive", "cache", "evidence", "statement_rules"},
    "comparison": {
        "averages", "companions", "config", "integrals", "io", "multiplicity", "multiplicity_figure", "sample",
        "systems",
    },
    "headline": {
        "averages", "clip", "config", "exposure", "headline_figure", "instruments", "integrals", "io", "multiplicity",
        "photometry", "precision", "prediction", "psf", "response", "sample", "shapes", "stars", "systems",
    },
    "figures": {"instruments"},
    "multiplicity_figure": {"figures"},
    "star_figures": {"figures", "stars"},
    "scatter_figure": {"figures"},
    "headline_figure": {"figures"},
    "diagrams": {"figures", "instruments"},
    "drawing": set(),
    "bibliography": set(),
    "page": {"bibliography", "drawing"},
    "tabulation": {"page", "summary"},
    "report": {
        "archive", "bibliography", "cache", "config", "diagrams", "drawing", "figures", "files", "galaxy",
        "instruments", "io", "page", "shapes", "star_figures", "tabulation",
    },
    "machine": set(),
    "timings": set(),
    "peers": {"photometry", "psf", "systems"},
    "floor": {"blocks", "pairs", "streams", "systems"},
    "bench": {
        "config", "floor", "machine", "peers", "psf", "response", "sample", "shapes", "simulation", "stack", "stamps",
        "systems", "timings",
    },
    "performance": {"figures", "files", "io", "markdown"},
    "terminal": {"files"},
    "answers": {
        "catalogs", "colour", "config", "distribution", "errors", "gaia", "integrals", "prediction", "response",
        "sample", "stars", "systems", "uncertainty",
    },
    "ledger": {"budget", "diagrams", "galaxies", "io", "shares"},
    "decision": {
        "answers", "budget", "colour", "config", "deconvolution", "errors", "galaxies", "instruments", "integrals",
        "io", "ledger", "psf", "resolution", "response", "sample", "shapes", "stars",
    },
    "remedy": {
        "answers", "config", "correction", "decision", "deconvolution", "errors", "extrapolation", "galaxies",
        "instruments", "patches", "prediction", "response", "sample", "samples", "shapes", "shear", "stars",
        "uncertainty",
    },
    "receipt": {"diagrams", "io"},
    "advice": {
        "answers", "choice", "clipping", "companions", "config", "decision", "deconvolution", "errors", "exposure",
        "galaxy", "instruments", "margin", "moments", "own_sizes", "precision", "psf", "response", "sample", "shapes",
        "shear", "stars", "truncation",
    },
    "notice": {"choice_figure", "errors", "files", "io"},
    "options": {"errors"},
    "survey_commands": {
        "advice", "decision", "ledger", "notice", "options", "receipt", "remedy", "terminal",
    },
    "cli": {
        "answers", "bench", "catalogs", "claims", "colour", "config", "errors", "experiments", "files",
        "findings", "instruments", "io", "kappa", "machine", "measurement", "options", "performance",
        "programme", "psf", "report", "response", "sample", "shapes", "simulation", "star_figures", "store",
        "summary", "survey_commands", "terminal", "toy",
    },
}  # fmt: skip
NEVER_REACHED = {  # followed through every module in between
    "prediction": {"simulation", "stack", "triples"},
    "triple_averages": {"blocks", "pairs", "simulation", "stack", "streams", "triples"},
    "deconvolution": {"stack", "simulation"},
    "colour": {"stack", "simulation"},
    "distribution": {"stack", "simulation"},
    "uncertainty": {"stack", "simulation"},
    "images": {"response", "weighted", "stack", "prediction"},
    "stack": {"clip", "prediction", "psf", "response", "triple_averages"},
    "clipping": {"simulation", "stack"},
    "margin": {"simulation", "stack"},
    "choice_figure": {"choice", "prediction", "stack"},
    "detection": {"prediction", "response", "stack"},
    "precision": {"prediction", "response", "stack"},
    "peers": {"stack", "pairs", "response", "weighted", "prediction"},
    "budget": {"stack", "simulation"},
    "correction": {"stack", "simulation"},
    "samples": {"stack", "simulation"},
    "figures": {"prediction", "stack", "simulation", "summary"},
    "diagrams": {"prediction", "stack", "simulation", "summary", "budget"},
}
UNIT = re.compile(
    r"arcsec|deg\b|deg²|rad\b|\bpc\b|\bau\b|mag\b|M_sun|\byr\b|dex|pixel|in \[0, 1\]|in \(0, 1|dimensionless|\(count\)"
    r"|file's unit|unit of the"
)
MODULES = sorted(p for p in SOURCE.glob("*.py") if not p.stem.startswith("__"))


def siblings_imported(tree):
    names = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module}
    names |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    return {n.split(".")[1] for n in names if n.startswith("porrima.")}


def reach(name, table):
    seen, todo = set(), [name]
    while todo:
        new = table.get(todo.pop(), set()) - seen
        seen |= new
        todo += new
    return seen


def is_compiled(node):
    """Compiled scalar functions say in one line what they take; their arguments have no types to check."""
    return any(re.search(r"njit|^_step$|^_loop$", ast.unparse(d)) for d in node.decorator_list)


def incomplete(node):
    doc = ast.get_docstring(node) or ""
    every = [*node.args.args, *node.args.kwonlyargs]
    arguments = [a.arg for a in every if a.arg not in ("self", "cls", "rng")]
    arrays = [a for a in every if a.annotation and "Array" in ast.unparse(a.annotation)]
    missing = [] if doc else ["docstring"]
    if arrays:
        missing += [] if re.search(r"\(\w.*\) (float|int|bool) array", doc) else ["shape"]
        missing += [] if UNIT.search(doc) else ["unit"]
    if arguments and "Parameters\n---" in doc:
        missing += [] if "Returns\n---" in doc else ["Returns"]
        missing += [f"parameter {a}" for a in arguments if not re.search(rf"\b{a}\b", doc)]
    elif arguments and len(doc.splitlines()) != 1:
        missing += ["Parameters"]
    if any(isinstance(n, ast.Raise) for n in ast.walk(node)) and "Raises\n---" not in doc:
        missing.append("Raises")
    return missing


def public_functions(tree):
    """Functions of the module and methods of its public classes; methods of a protocol may be one line."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_") and not is_compiled(node):
            yield node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from (n for n in node.body if isinstance(n, ast.FunctionDef) and not n.name.startswith("_"))


def test_the_table_names_every_module():
    assert {p.stem for p in MODULES} == set(UPSTREAM)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: p.stem)
def test_module_imports_only_from_upstream(path):
    assert siblings_imported(ast.parse(path.read_text(encoding="utf-8"))) <= UPSTREAM[path.stem]


def test_no_arrow_comes_back():
    assert not [name for name in UPSTREAM if name in reach(name, UPSTREAM)]


@pytest.mark.parametrize("name", NEVER_REACHED)
def test_theory_never_sees_the_simulation(name):
    assert not reach(name, UPSTREAM) & NEVER_REACHED[name]


@pytest.mark.parametrize(
    "path", [p for p in MODULES if p.stem not in ("cli", "survey_commands")], ids=lambda p: p.stem
)
def test_public_docstrings_are_whole(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert not {n.name: incomplete(n) for n in public_functions(tree) if incomplete(n)}


@pytest.mark.parametrize("path", MODULES, ids=lambda p: p.stem)
def test_modules_and_functions_stay_small(path):
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") <= 500
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            doc = ast.get_docstring(node, clean=False) or ""
            assert node.end_lineno - node.lineno - doc.count("\n") <= 60, node.name


def test_the_rules_catch_what_they_should():
    node = ast.parse(
        "def f(x: FloatArray):\n    '''Short.\n\n    Parameters\n    ---\n    '''\n    raise ValueError"
    ).body[0]
    assert set(incomplete(node)) == {"shape", "unit", "Returns", "Raises", "parameter x"}
    assert incomplete(ast.parse("def f(x: int):\n    pass").body[0]) == ["docstring", "Parameters"]
    assert reach("prediction", {"prediction": {"response"}, "response": {"stack"}}) == {"response", "stack"}
