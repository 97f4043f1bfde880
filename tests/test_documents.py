"""The documents tell the truth: what they show runs, what they name exists, what exists they name."""

import ast
import contextlib
import io
import json
import re
import shlex
import sys
from itertools import chain
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import typer
import yaml

import porrima
from porrima.catalogs import READERS
from porrima.cli import app, main
from porrima.comparison import ORBITS, mean_x_by_model
from porrima.config import (
    GalaxiesConfig,
    Multiplicity,
    Photometry,
    RequirementConfig,
    RunConfig,
    StarsConfig,
    parse,
)  # fmt: skip
from porrima.criteria import OPTIONS
from porrima.instruments import SURVEYS
from porrima.multiplicity import MULTIPLICITY
from porrima.patches import COLUMNS
from porrima.performance import BEGIN, END, with_tables
from porrima.photometry import PHOTOMETRY, MainSequence
from porrima.psf import PSFS
from porrima.shapes import ESTIMATORS

ROOT = Path(__file__).parents[1]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md")), *TUTORIALS]
README, COMMANDS, MODELS = ROOT / "README.md", ROOT / "docs" / "commands.md", ROOT / "docs" / "models.md"
BENCH = ROOT / "docs" / "bench.json"
INDEX, API = ROOT / "docs" / "index.md", ROOT / "docs" / "api.md"
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
KEY = re.compile(r"\b[A-Z][A-Za-z]*\d{2,4}[a-z]?\b")  # KCM16, Robin2003
GROUP = typer.main.get_command(app)
every_command = pytest.mark.parametrize("command", sorted(GROUP.commands))


def fenced(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S)


def command_lines():
    for path in DOCUMENTS:
        for block in fenced(path, "sh"):
            for line in block.splitlines():
                if line.startswith("porrima "):
                    yield pytest.param(line, id=f"{path.name}: {line}")


def cells(path):
    """Code of a document in its order: what is Python, and whether it is; of the rest, lines of commands."""
    text = path.read_text(encoding="utf-8")
    for kind, body in re.findall(r"^```(\{code-cell\} ipython3|python|sh)\n(.*?)^```", text, re.M | re.S):
        if kind == "sh":
            yield False, [line for line in body.splitlines() if line.startswith("porrima ")]
        elif body.startswith("!"):
            yield False, [line[1:] for line in body.splitlines()]
        else:
            yield True, body


def carried_out(line):
    """What a command prints on standard output, which a last part ``> FILE`` catches."""
    words, _, file = line.partition(" > ")
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as out:
        patch.setattr(sys, "argv", shlex.split(words))
        with pytest.raises(SystemExit) as end:
            main()
    assert end.value.code == 0, line
    if file:
        Path(file).write_text(out.getvalue(), encoding="utf-8")


def section(command):
    """What docs/commands.md says of one command."""
    text = COMMANDS.read_text(encoding="utf-8")
    found = re.search(rf"^## `porrima {command}`\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    return found[1] if found else ""


def options(command):
    return {
        name for parameter in GROUP.commands[command].params for name in parameter.opts if name[:2] == "--"
    }


def json_of(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["porrima", *map(str, arguments), "--json"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 0
    return json.loads(capsys.readouterr().out)


def keys_of(result):
    """Keys of a JSON object and of the first object in each of its lists."""
    inner = [value[0] for value in result.values() if isinstance(value, list)]
    return set(result).union(*map(set, inner))


def slug(heading):
    """Anchor that a heading gets."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def headings(path):
    return {slug(heading) for heading in re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.M)}


def references_in(docstring):
    body = re.search(r"^References\n-+\n(.*?)(?=\n\n|\Z)", docstring, re.M | re.S)
    return set(KEY.findall(body[1])) if body else set()


def bibliography():
    return re.findall(r"^@\w+\{(\w+),", (ROOT / "docs" / "references.bib").read_text(encoding="utf-8"), re.M)


def test_the_python_of_the_readme_prints_what_the_readme_says(capsys):
    (block,), (printed,) = fenced(README, "python"), fenced(README, "text")
    exec(compile(block, "README.md", "exec"), {})
    assert capsys.readouterr().out == printed


@pytest.mark.parametrize("line", list(command_lines()))
def test_every_command_line_shown_is_one_that_porrima_takes(line):
    words = shlex.split(line.split(" > ")[0])[1:]
    command = GROUP.commands[words[0]]
    command.make_context(words[0], words[1:])


def test_the_commands_of_the_readme_run_one_after_the_other(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("pairs.csv").write_text("flux_ratio,dx,dy\n0,0,0\n0.5,0.03,0.01\n")
    Path("patches.csv").write_text("r2,n_stars,mag_lo,mag_hi\n9.67e-3,2000,18,19\n")
    lines = [line for is_python, block in cells(README) if not is_python for line in block]
    for line in lines:
        if not line.startswith("porrima paper"):  # a minute; its experiments have tests of their own
            carried_out(line)
    assert len(lines) > 10


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda p: p.stem)
def test_every_cell_and_command_of_a_tutorial_runs(path, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")
    names = {}
    for number, (is_python, block) in enumerate(cells(path)):
        if is_python:
            exec(compile(block, f"{path.name}, cell {number}", "exec"), names)
        else:
            for line in block:
                carried_out(line)
        plt.close("all")


def test_the_index_of_the_site_names_every_page():
    named = set(re.findall(r"^([\w/-]+)$", "".join(fenced(INDEX, "{toctree}")), re.M))
    pages = {p.relative_to(INDEX.parent).with_suffix("").as_posix() for p in DOCUMENTS if p.parent != ROOT}
    assert pages - {"index"} <= named


def test_the_page_of_the_package_has_every_module_once():
    named = re.findall(r"^   porrima\.(\w+)$", API.read_text(encoding="utf-8"), re.M)
    assert sorted(named) == sorted(
        p.stem for p in (ROOT / "src" / "porrima").glob("*.py") if p.stem != "__init__"
    )


@every_command
def test_every_option_of_a_command_is_documented_and_no_other(command):
    shown = set(OPTION.findall(section(command))) - {"--help"}
    assert shown == options(command) - {"--help"}


def test_the_readme_shows_every_command_but_the_benchmark():
    assert {
        line.split()[1] for block in fenced(README, "sh") for line in block.splitlines() if "porrima " in line
    } >= {*GROUP.commands} - {"bench"}


def test_every_json_key_is_documented(monkeypatch, capsys, tmp_path):
    pairs, patches, stars, config, run = (
        tmp_path / name for name in ("pairs.csv", "patches.csv", "stars.ecsv", "run.yaml", "run.zarr")
    )
    patches.write_text("r2,n_stars,e1,e2\n6.785e-3,2000,0.05,0\n")
    pairs.write_text("flux_ratio,dx,dy\n0,0,0\n0.5,0.03,0.01\n")
    config.write_text(
        "stars: {l: 180, b: 45, mag: [18, 19], n_drawn: 200}\nn_stacks: 8\nn_stars: 5\npsf: psf1\n"
    )
    results = {
        "stars": ["--l", 180, "--b", 60, "--area", 0.2, "--mag", 18, 19, "-o", stars],
        "predict": ["--stars", stars, "--mag", 18, 19, "--psf", "psf1", "--n-stars", 40],
        "budget": ["--stars", stars, "--mag", 18, 19, "--instrument", "kcm16"],
        "select": ["--survey", "euclid-vis", "--stars", stars, "--area", 1, "--mag", 18, 19, "--clip", 0.01],
        "correct": [patches, "--stars", stars, "--mag", 18, 19, "--instrument", "kcm16"],
        "measure": [pairs, "--psf", "psf1"],
        "simulate": [config, "-o", run],
        "summary": [run, "--bins", 1],
        "report": [run, "--bins", 1, "-o", tmp_path / "report.html"],
    }
    for command, arguments in results.items():
        keys = keys_of(json_of(monkeypatch, capsys, command, *arguments))
        text = section(command) + (section("summary") if command == "report" else "")
        missing = {key for key in keys if f"`{key}`" not in text}
        assert not missing, (command, missing)


def test_every_key_of_a_benchmark_is_documented():
    missing = {key for key in keys_of(json.loads(BENCH.read_text())) if f"`{key}`" not in section("bench")}
    assert not missing


def test_the_tables_of_the_performance_page_are_those_of_its_benchmark():
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    assert page.count(BEGIN) == page.count(END) == 1
    assert page == with_tables(page, json.loads(BENCH.read_text(encoding="utf-8")))


def test_every_key_of_the_configuration_is_documented():
    table = section("simulate")
    expected = {f"stars.{name}" for name in StarsConfig.model_fields}
    expected |= set(RunConfig.model_fields) - {"stars"}
    expected |= set(Multiplicity.model_fields) | set(Photometry.model_fields)
    expected |= {*chain.from_iterable(OPTIONS.values()), *(f"selection.{kind}" for kind in OPTIONS)}
    assert not {name for name in expected if f"`{name}`" not in table}


def test_every_key_of_galaxies_and_requirements_is_documented():
    expected = {*GalaxiesConfig.model_fields, *RequirementConfig.model_fields}
    assert not {name for name in expected if f"`{name}`" not in section("budget")}


def test_configurations_shown_are_valid():
    shown = [block for path in DOCUMENTS for block in fenced(path, "yaml")]
    assert shown
    for block in shown:
        parse(RunConfig, {"stars": {"l": 0, "b": 90, "mag": [18, 19]}} | yaml.safe_load(block))


def test_every_model_format_and_band_has_its_name_in_the_documents():
    text = COMMANDS.read_text(encoding="utf-8") + MODELS.read_text(encoding="utf-8")
    bands = {band for band in MainSequence().bands if not band.startswith("roman_")}
    names = {*MULTIPLICITY, *PHOTOMETRY, *PSFS, *ESTIMATORS, *READERS, *SURVEYS, *bands}
    assert not {name for name in names if f"`{name}`" not in text}


@pytest.mark.parametrize("model", ["dk13", "dk13-kcm16"])
def test_the_headline_table_is_what_predict_gives(monkeypatch, capsys, model):
    text = MODELS.read_text(encoding="utf-8")
    header = re.search(r"^\| i \(AB\) \|(.*)\|$", text, re.M)[1].split("|")
    row = re.search(rf"^\| `{model}`, Galaxy \|(.*)\|$", text, re.M)[1].split("|")
    shown = dict(zip((cell.strip() for cell in header), map(float, row), strict=True))
    line = f"predict --l 180 --b 45 --mag 18 19 --psf psf0 --binary-fraction 0.35 --multiplicity {model}"
    result = json_of(monkeypatch, capsys, *line.split())
    assert 1e4 * result["eta"] == pytest.approx(shown["18–19"], rel=0.02)


def test_the_table_of_models_is_what_they_give():
    text = MODELS.read_text(encoding="utf-8")
    found = mean_x_by_model(np.array([18.0, 19.0]))["mean_x"]
    for model in MULTIPLICITY:
        for orbits in ORBITS:
            row = re.search(rf"^\| `{model}`, {orbits} \|(.*)\|$", text, re.M)[1].split("|")
            value = 1e6 * float(found.sel(model=model, orbits=orbits, bin=0))
            assert float(row[2]) == pytest.approx(value, rel=0.01)


def test_every_key_and_column_of_samples_corrected_is_documented(monkeypatch, capsys, tmp_path):
    table = tmp_path / "clips.csv"
    table.write_text("r2,n_stars,eta,sd\n6.781e-3,1900,2e-4,1e-3\n6.785e-3,2000,1e-3,6e-3\n")
    options = [table, "--method", "extrapolate", "--psf", "psf1"]
    keys = keys_of(json_of(monkeypatch, capsys, "correct", *options)) | set(COLUMNS)
    assert not {key for key in keys if f"`{key}`" not in section("correct")}


@pytest.mark.parametrize("model", ["dk13", "dk13-kcm16"])
def test_the_budget_table_is_what_budget_gives(monkeypatch, capsys, model):
    text = (ROOT / "docs" / "budget.md").read_text(encoding="utf-8").split("## The paper's own setting")[1]
    table = text.split(f"`{model}`, requirement met at")[1]
    cells = re.search(r"^\| 18–19 \|(.*)\|$", table, re.M)[1].split("|")
    line = (
        f"budget --instrument kcm16 --l 180 --b 45 --binary-fraction 0.35 --mag 18 19 --multiplicity {model}"
    )
    result = json_of(monkeypatch, capsys, *line.split())
    size = next(row for row in result["shares"] if row["quantity"] == "r2")
    (verdict,) = result["verdicts"]
    shown = [float(cells[k].split("%")[0].split("(")[0]) for k in range(3)]
    expected = [
        1e4 * result["bins"][0]["eta"],
        100 * size["total_share"],
        100 * result["shares"][0]["total_share"],
    ]
    assert shown == pytest.approx(expected, rel=0.02)
    assert cells[3].strip() == verdict["verdict"]


def test_the_table_of_chosen_stars_is_what_select_gives(monkeypatch, capsys):
    text = (ROOT / "docs" / "select.md").read_text(encoding="utf-8").split("**Euclid VIS, b = 75°**")[1]
    cells = [cell.strip() for cell in re.search(r"^\| \*\*best\*\* \|(.*)\|$", text, re.M)[1].split("|")]
    line = "select --survey euclid-vis --l 180 --b 75 --mag 16 20 --clip 0.004770664608946602 --exposures 4"
    best = json_of(monkeypatch, capsys, *line.split())["best"]
    assert cells[0] == f"{best['mag_lo']:g}–{best['mag_hi']:g}"
    assert cells[1] == f"{100 * best['clip']:.2f} %"
    shown = [float(cells[3]), float(cells[4].split()[0]), float(cells[6]), float(cells[7])]
    expected = [best["n_stars"], best["merit"], best["share_r2"], 1e4 * best["binaries_r2"]]
    assert shown == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("name", "pixel"), [("optical1", None), ("roman:H158:SCA01", 0.11)])
def test_the_table_of_psf_sizes_is_what_predict_gives(monkeypatch, capsys, name, pixel):
    text = (ROOT / "docs" / "budget.md").read_text(encoding="utf-8")
    label = {"optical1": "`optical1`", "roman:H158:SCA01": "Roman H158, pixel"}[name]
    cells = re.search(rf"^\| {label} \|(.*)\|$", text, re.M)[1].split("|")
    line = f"predict --l 180 --b 45 --mag 18 19 --binary-fraction 0.35 --psf {name}"
    result = json_of(monkeypatch, capsys, *line.split(), *(["--pixel", pixel] if pixel else []))
    assert [float(cells[2]), float(cells[3])] == pytest.approx(
        [1e4 * result["eta"], 1e4 * result["bias_r2"]], rel=0.02
    )


@pytest.mark.parametrize("path", sorted((ROOT / "src" / "porrima").glob("*.py")), ids=lambda p: p.stem)
def test_every_reference_of_a_docstring_is_in_the_bibliography(path):
    kinds = ast.Module | ast.ClassDef | ast.FunctionDef
    nodes = [
        node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, kinds)
    ]
    cited = set().union(*(references_in(ast.get_docstring(node) or "") for node in nodes))
    assert cited <= set(bibliography())


def test_the_bibliography_has_each_key_once_with_author_title_and_year():
    keys = bibliography()
    assert len(keys) == len(set(keys))
    entries = (ROOT / "docs" / "references.bib").read_text(encoding="utf-8").split("\n@")[1:]
    for entry in entries:
        assert all(re.search(rf"^  {name}\s*= \{{", entry, re.M) for name in ("author", "title", "year")), (
            entry
        )
        assert entry.count("{") == entry.count("}"), entry
    cited = KEY.findall(MODELS.read_text(encoding="utf-8").split("## References")[1])
    assert cited
    assert set(cited) <= set(keys)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: p.name)
def test_every_link_between_documents_leads_somewhere(path):
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.M | re.S)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith(("https://", "http://", "mailto:")):
            continue
        name, _, anchor = link.partition("#")
        target = (path.parent / name) if name else path
        assert target.is_file(), link
        assert not anchor or anchor in headings(target), link


def test_the_citation_is_of_this_version_and_of_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors", "version", "license", "references"} <= set(citation)
    assert citation["cff-version"] == "1.2.0"
    assert str(citation["version"]) == porrima.__version__
    assert citation["license"] == "BSD-3-Clause"
    (paper,) = citation["references"]
    assert {"type", "title", "authors"} <= set(paper)
    assert [author["family-names"] for author in paper["authors"]] == ["Kuntzer", "Courbin", "Meylan"]
    assert "arXiv:1512.01549" in {identifier["value"] for identifier in paper["identifiers"]}


def test_the_changelog_has_this_version_and_says_whether_numbers_change():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    release = re.search(rf"^## \[{re.escape(porrima.__version__)}\].*?(?=^## |\Z)", text, re.M | re.S)
    assert release
    assert "numbers change:" in release[0]
