"""The commands as a user types them: JSON keys of the contract, one line and exit code 2 for wrong input."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray as xr

from porrima.catalogs import read_catalog
from porrima.diagrams import colour_against_eta
from porrima.errors import RunError

PREDICT_KEYS = {
    "mean_x", "mean_x2", "eta", "bias_e1", "bias_e2", "bias_r2", "sigma_e1", "sigma_e2", "sigma_r2", "sd_e1", "sd_e2",
    "sd_r2", "n_stars", "binary_fraction", "unresolved_fraction", "removed_fraction",
}  # fmt: skip
CONFIG = "stars: {{catalog: {stars}, mag: [18, 19]}}\nn_stacks: 500\nn_stars: 10\nestimator: plain\n"


@pytest.fixture(scope="module")
def stars_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("cli") / "stars.ecsv"
    rng = np.random.Generator(np.random.Philox(8))
    lines = [
        f"{m},{d},{i}"
        for m, d, i in zip(
            rng.uniform(0.1, 1.4, 60), rng.uniform(100, 4e3, 60), rng.uniform(18, 20, 60), strict=True
        )
    ]
    path = path.with_suffix(".csv")
    path.write_text("mass,distance,magnitude\n" + "\n".join(lines) + "\n")
    return path


@pytest.fixture
def config(tmp_path, stars_file):
    path = tmp_path / "run.yaml"
    path.write_text(CONFIG.format(stars=stars_file))
    return path


def test_stars_of_the_galaxy(porrima, tmp_path):
    code, out, _ = porrima(
        "stars", "--l", 180, "--b", 45, "--area", 0.3, "--mag", 17, 19.5, "-o", tmp_path / "s.ecsv", "--json"
    )
    result = json.loads(out)
    assert code == 0
    assert set(result) == {"n", "area_deg2", "counts"}
    assert result["area_deg2"] == 0.3
    assert [(c["mag_lo"], c["mag_hi"]) for c in result["counts"]] == [(17, 18), (18, 19), (19, 19.5)]
    assert set(result["counts"][0]) == {
        "mag_lo", "mag_hi", "n", "n_per_deg2", "median_distance_pc", "mean_mass", "mean_multiplicity_fraction",
    }  # fmt: skip
    back = read_catalog(tmp_path / "s.ecsv").stars
    assert len(back) == result["n"] == sum(c["n"] for c in result["counts"])


def test_a_selection_has_a_picture(porrima, stars_file, tmp_path):
    for name in ("stars.png", "stars.pdf", "stars.svg"):
        code, _, _ = porrima(
            "stars", "--catalog", stars_file, "--mag", 18, 19, "--plot", tmp_path / name, "--json"
        )
        assert code == 0
        assert (tmp_path / name).stat().st_size > 1000


def test_a_seed_gives_the_same_stars(porrima):
    one, same, other = (
        porrima("stars", "--l", 180, "--b", 45, "--area", 0.1, "--mag", 18, 19, "--seed", s, "--json")[1]
        for s in (1, 1, 2)
    )
    assert one == same != other


def test_stars_of_a_catalogue_are_summarised(porrima, stars_file):
    code, out, _ = porrima("stars", "--catalog", stars_file, "--mag", 18, 19, "--json")
    result = json.loads(out)
    assert code == 0
    assert result["area_deg2"] is None
    assert result["counts"][0]["n_per_deg2"] is None


@pytest.mark.parametrize("estimator", ["adaptive", "plain", "gaussian:0.1"])
def test_measure_by_response_and_by_images(porrima, tmp_path, estimator):
    table = tmp_path / "pairs.csv"
    table.write_text("flux_ratio,dx,dy\n0.5,0.01,0.02\n0,0,0\n1.0,0.03,-0.02\n")
    results = {}
    for method in ("response", "images"):
        code, out, _ = porrima(
            "measure", table, "--psf", "psf1", "--estimator", estimator, "--method", method, "--json"
        )
        assert code == 0
        results[method] = json.loads(out)
        assert set(results[method]) == {"e1", "e2", "r2", "e1_0", "e2_0", "r2_0", "de1", "de2", "dr2_rel"}
    for name in ("de1", "de2", "dr2_rel"):
        assert abs(results["response"][name] - results["images"][name]) < 1e-4 * results["images"]["dr2_rel"]


def test_response_has_the_keys_of_the_contract(porrima):
    code, out, _ = porrima("response", "--psf", "psf1", "--json")
    result = json.loads(out)
    assert code == 0
    assert set(result) >= {"r2_0", "e1_0", "e2_0", "kappa_r2", "de1_deta", "de2_deta", "derivatives"}
    assert result["kappa_r2"] == pytest.approx(1)
    assert set(result["derivatives"][0]) == {"moment", "order", "de1", "de2", "dr2"}
    code, out, _ = porrima("response", "--psf", "psf1", "--psf", "psf0", "--estimator", "plain", "--json")
    assert [(r["psf"], r["estimator"]) for r in json.loads(out)["responses"]] == [
        ("psf1", "plain"),
        ("psf0", "plain"),
    ]


def test_toy_writes_its_figure(porrima, tmp_path):
    code, out, _ = porrima("toy", "-o", tmp_path / "toy", "--points", 5, "--json")
    result = json.loads(out)
    assert code == 0
    assert (tmp_path / "toy" / "toy.png").exists()
    assert [c["delta_m"] for c in result["contrasts"]] == [0, 1]


def test_predict_has_the_keys_of_the_contract(porrima, stars_file):
    code, out, _ = porrima("predict", "--stars", stars_file, "--mag", 18, 19, "--psf", "psf1", "--json")
    result = json.loads(out)
    assert code == 0
    assert set(result) >= PREDICT_KEYS
    assert result["n_stars"] is None
    assert result["binary_fraction"] is None
    assert result["sd_r2"] == 0
    assert result["sigma_e1"] == pytest.approx(abs(result["bias_e1"]))
    code, out, _ = porrima(
        "predict", "--catalog", stars_file, "--mag", 18, 19, "--psf", "psf1", "--binary-fraction", 0.35, "--n-stars",
        40, "--estimator", "plain", "--multiplicity", "dk13-kcm16", "--photometry", "habets-heintze", "--json",
    )  # fmt: skip
    result = json.loads(out)
    assert result["binary_fraction"] == 0.35
    assert result["n_stars"] == 40
    assert result["eta"] == pytest.approx(result["mean_x"] / 6.77941e-3, rel=1e-5)
    assert result["bias_r2"] == pytest.approx(result["eta"])
    assert result["sigma_r2"] == pytest.approx(np.hypot(result["bias_r2"], result["sd_r2"]))


def test_models_take_options_on_the_command_line(porrima, stars_file):
    def eta(*options):
        code, out, err = porrima(
            "predict", "--stars", stars_file, "--mag", 18, 19, "--psf", "psf0", *options, "--json"
        )
        assert code == 0, err
        return json.loads(out)["eta"]

    named = eta("--multiplicity", "dk13-kcm16")
    spelt = eta("--multiplicity", "{model: dk13, gap_rule: solar, a_max_factor: 2.5}")
    assert named == spelt != eta("--multiplicity", "{model: dk13, gap_rule: solar}")
    assert eta("--photometry", "{model: habets-heintze, branch: primary}") != eta(
        "--photometry", "habets-heintze"
    )


def test_predict_from_the_galaxy(porrima):
    code, out, _ = porrima("predict", "--l", 180, "--b", 45, "--mag", 18, 19, "--psf", "psf0", "--json")
    assert code == 0
    assert 0.1 < json.loads(out)["removed_fraction"] < 0.3


def test_predict_gives_intervals_covariance_and_quantiles(porrima, stars_file):
    arguments = ["predict", "--stars", stars_file, "--mag", 18, 19, "--psf", "psf1", "--json"]
    result = json.loads(porrima(*arguments, "--n-stars", 40)[1])
    for name in ("eta", "bias_e1", "sigma_r2", "sd_e2"):
        assert result[f"{name}_low"] <= result[name] <= result[f"{name}_high"]
    assert result["covariance_e1_e1"] == pytest.approx(result["sd_e1"] ** 2)
    quantiles = [row["dr2_rel"] for row in result["size_quantiles"]]
    assert quantiles == sorted(quantiles)
    assert 0 < result["quadrature_error"] < 1e-4
    assert result["sources"][0]["change"] >= result["sources"][1]["change"]
    crossed = json.loads(porrima(*arguments, "--n-stars", round(result["crossover_n_stars_r2"]))[1])
    assert crossed["sd_r2"] == pytest.approx(crossed["bias_r2"], rel=0.02)
    endless = json.loads(porrima(*arguments)[1])
    assert endless["size_quantiles"] is None
    assert endless["covariance_lnr2_lnr2"] == 0
    weighted = json.loads(porrima(*arguments, "--n-stars", 40, "--stack-weight", "flux")[1])
    assert weighted["eta_low"] is None
    assert weighted["size_quantiles"] is None


def test_the_colour_of_companions_comes_only_where_asked_for(porrima, stars_file, tmp_path):
    blur = ["--psf", "optical1", "--pixel", 0.1, "--jitter", 0.029]
    where = ["--stars", stars_file, "--mag", 18, 19]
    plain = json.loads(porrima("predict", *where, *blur, "--json")[1])
    coloured = json.loads(porrima("predict", *where, *blur, "--colour", "euclid_VIS", "--json")[1])
    names = [name for name in plain if name.startswith("colour_")]
    assert len(names) == 5
    assert all(plain[name] is None for name in names)
    assert all(coloured[name] == plain[name] for name in plain if name not in names)
    assert coloured["colour_band"] == "euclid_VIS"
    assert 0.3 < coloured["colour_r2"] / coloured["colour_eta"] < 2
    assert abs(coloured["colour_r2_known"]) < 0.1 * coloured["colour_r2"]
    budget = ["budget", "--instrument", "euclid-vis", *where, "--colour", "euclid_VIS"]
    code, out, err = porrima(*budget, "--json")
    assert code == 0, err
    result = json.loads(out)
    (row,) = result["bins"]
    assert [row[name] for name in names] == pytest.approx([coloured[name] for name in names])
    figure = colour_against_eta({"Euclid VIS": result})
    (axis,) = figure.axes
    drawn = [float(y) for line in axis.lines for y in line.get_ydata()]
    assert row["colour_r2"] in drawn
    _, out, _ = porrima(*budget)
    assert "companions' colour in euclid_VIS" in out
    code, out, err = porrima("predict", *where, "--psf", "psf1", "--colour", "euclid_VIS")
    assert code == 2
    assert err.strip().endswith("error: colour: needs an optical, Roman or chromatic PSF, got psf1")


@pytest.mark.parametrize("instrument", ["euclid-vis", "rubin", "kcm16"])
def test_a_budget_of_a_survey(porrima, stars_file, tmp_path, instrument):
    arguments = ["budget", "--instrument", instrument, "--stars", stars_file, "--mag", 18, 20]
    code, out, err = porrima(
        *arguments, "--json", "-o", tmp_path / "shares.ecsv", "--plot", tmp_path / "shares.png"
    )
    assert code == 0, err
    result = json.loads(out)
    assert [(b["mag_lo"], b["mag_hi"]) for b in result["bins"]] == [(18, 19), (19, 20)]
    assert len(result["shares"]) == 2 * 9
    for row in result["shares"]:
        assert row["total"] == pytest.approx(np.hypot(row["bias"], row["scatter"]))
        assert (row["required"] is None) == (row["verdict"] is None)
    assert (tmp_path / "shares.png").stat().st_size > 1000
    assert len((tmp_path / "shares.ecsv").read_text().splitlines()) > 18
    code, table, _ = porrima(*arguments)
    assert code == 0
    assert "18-19" in table


def test_a_budget_takes_requirements_and_galaxies_from_files(porrima, stars_file, tmp_path):
    (tmp_path / "mine.yaml").write_text("name: mine\nsigma_r2: 1e-3\nm: 2e-3\n")
    (tmp_path / "galaxies.csv").write_text("half_light_radius,weight\n0.2,1\n0.4,3\n")
    sizes = {}
    for name in (
        tmp_path / "galaxies.csv",
        "{half_light_radius: 0.4}",
        "{half_light_radius: 0.4, scatter: 0.1}",
    ):
        code, out, err = porrima(
            "budget", "--requirements", tmp_path / "mine.yaml", "--stars", stars_file, "--mag", 18, 19, "--step", 0.5,
            "--galaxies", name, "--psf", "psf0", "--json",
        )  # fmt: skip
        assert code == 0, err
        result = json.loads(out)
        assert (result["requirement"], result["required_m"], result["required_c"]) == ("mine", 2e-3, None)
        assert len(result["bins"]) == 2
        sizes[str(name)] = result["galaxy_inverse_r2"]
    table, one, law = sizes.values()
    assert table == pytest.approx(one * (0.25 * 4 + 0.75))
    assert law == pytest.approx(one * np.exp(0.5 * (0.2 * np.log(10)) ** 2), rel=1e-6)


def test_simulate_and_summary(porrima, config, tmp_path):
    store = tmp_path / "run.zarr"
    code, out, err = porrima("simulate", config, "-o", store, "--json")
    assert code == 0, err
    result = json.loads(out)
    assert set(result) >= {"n_stacks", "n_stars", "wall_s", "stars_per_s"}
    assert (result["n_stacks"], result["n_stars"]) == (500, 10)
    code, out, _ = porrima("simulate", config, "-o", store, "--resume", "--json")
    assert json.loads(out)["n_stacks_computed"] == 0
    code, out, _ = porrima("summary", store, "--bins", 2, "-o", tmp_path / "bins.ecsv", "--json")
    assert code == 0
    bins = json.loads(out)["bins"]
    assert len(bins) == 3 * 3 * 2
    assert sum(b["n_stacks"] for b in bins if b["psf"] == "psf0" and b["quantity"] == "r2") == 500
    assert (tmp_path / "bins.ecsv").exists()


def test_a_seed_on_the_command_line_wins(porrima, config, tmp_path):
    porrima("simulate", config, "-o", tmp_path / "run.zarr", "--seed", 77)
    assert json.loads(xr.open_zarr(tmp_path / "run.zarr").attrs["config"])["seed"] == 77


def test_the_example_configuration_can_be_run(porrima, tmp_path):
    code, out, _ = porrima("simulate", "--example")
    path = tmp_path / "example.yaml"
    path.write_text(out.replace("n_stacks: 100000", "n_stacks: 100"))
    assert code == 0
    assert porrima("simulate", path, "-o", tmp_path / "run.zarr")[0] == 0


def test_tables_are_printed_without_json(porrima, stars_file):
    code, out, _ = porrima("predict", "--stars", stars_file, "--mag", 18, 19, "--psf", "psf1")
    assert code == 0
    assert "mean_x" in out


PREDICT = ["predict", "--stars", "{stars}", "--mag", "18", "19", "--psf", "psf1"]
GALAXY = ["stars", "--l", "180", "--b", "45"]
BUDGET = ["budget", "--instrument", "kcm16", "--stars", "{stars}", "--mag", "18", "19"]
WRONG = [  # arguments, what the one line says
    (["stars", "--catalog", "{missing_column}"], "missing.csv, column distance: must be in the table"),
    (["stars", "--catalog", "{truncated}"], "truncated.csv, row 3"),
    (["stars", "--catalog", "{nan_mass}"], "nan.csv, row 3, column mass"),
    (["stars", "--catalog", "{negative}"], "negative.csv, row 2, column distance"),
    (["stars", "--catalog", "{stars}", "--mag", "1", "2"], "with magnitude in [1.0, 2.0)"),
    (["stars", "--catalog", "absent.csv"], "absent.csv: must be a readable file"),
    (["stars", "--mag", "18", "19"], "must have either a direction (l and b) or a catalogue"),
    (["stars", "--l", "180", "--b", "95"], "b: must be less than or equal to 90, got 95"),
    ([*GALAXY, "--mag", "18"], "--mag"),
    ([*GALAXY, "--area", "0.01", "--mag", "18", "19", "-o", "nowhere/s.ecsv"], "nowhere/s.ecsv"),
    (["stars", "--catalog", "{stars}", "--plot", "stars.xyz"], "plot: must end in .png, .pdf or .svg, got stars.xyz"),
    (["stars", "--catalog", "{stars}", "--map", "mass"], "--map: must be column=name,column=name, got mass"),
    (["stars", "--catalog", "{stars}", "--format", "trileg"], "format: must be one of besancon, trilegal, gaia, table"),
    (["predict", "--stars", "{stars}", "--mag", "18", "19", "--psf", "psf9"], "psf: must be one of psf0, psf1, psf2"),
    ([*PREDICT, "--binary-fraction", "1.2"], "--binary-fraction: must be in [0, 1], got 1.2"),
    ([*PREDICT, "--n-stars", "0"], "--n-stars: must be at least 1, got 0"),
    ([*PREDICT, "--cut", "0"], "cut: must be greater than 0"),
    ([*PREDICT, "--multiplicity", "dk12"], "modern (did you mean dk13"),
    ([*PREDICT, "--multiplicity", "{{gap_rule: upper}}"], "gap_rule: must be 'lower', 'solar',"),
    ([*PREDICT, "--multiplicity", "{{gap"], "--multiplicity: must be a name or {model: name, option: value}"),
    ([*PREDICT, "--cut", "0.5"], "--cut: is too wide for the kernel moments of this PSF"),
    ([*PREDICT, "--format", "table"], "--stars: cannot be given together with --format"),
    ([*PREDICT, "--multiplicity", "{{gap_rule: null}}"], "multiplicity: gap_rule must be lower or solar, got None"),
    ([*BUDGET[:1], *BUDGET[3:]], "--instrument: must be one of euclid-vis, roman-h158, rubin, kcm16, massey13"),
    (["budget", "--instrument", "euclid", *BUDGET[3:]], "(did you mean euclid-vis?), got euclid"),
    ([*BUDGET, "--requirements", "{typo}"], "typo.yaml, sigma_r: is not a key (did you mean sigma_r2?)"),
    ([*BUDGET, "--requirements", "{nothing}"], "must have at least one of sigma_e, sigma_r2, m, c"),
    ([*BUDGET, "--requirements", "{broken}"], "broken.yaml, row 2: is not YAML"),
    ([*BUDGET, "--requirements", "{below}"], "below.yaml, m: must be greater than 0, got -1"),
    ([*BUDGET, "--requirements", "absent.yaml"], "absent.yaml: cannot be read (No such file or directory)"),
    ([*BUDGET, "--galaxies", "{no_galaxies}"], "no_galaxies.csv, row 1: must have rows below its header"),
    ([*BUDGET, "--galaxies", "{small}"], "column half_light_radius: must be positive and finite [arcsec], got -0.1"),
    ([*BUDGET, "--galaxies", "{pairs}"], "column half_light_radius: is missing; the table has flux_ratio, dx, dy"),
    ([*BUDGET, "--galaxies", "{{half_light_radius: -1}}"], "--galaxies, half_light_radius: must be greater than 0"),
    ([*BUDGET, "--galaxies", "{{half"], "--galaxies: must be a table or {key: value, ...}, got {half"),
    ([*BUDGET, "--galaxies", "{{half_light_radius: 0.1, smallest: 5}}"], "leaves no galaxies"),
    ([*BUDGET, "--galaxy-size", "-0.3"], "--galaxy-size: must be positive and finite [arcsec], got -0.3"),
    ([*BUDGET, "--galaxy-size", "1", "--galaxies", "x"], "--galaxy-size: cannot be given together with --galaxies"),
    ([*BUDGET, "--n-stars", "0"], "--n-stars: must be at least 1, got 0"),
    ([*BUDGET, "--binary-fraction", "-1"], "--binary-fraction: must be in [0, 1], got -1.0"),
    ([*BUDGET, "--cut", "0.5"], "whose expansion stops being good at order 2, got 0.5"),
    ([*BUDGET, "--mag", "18", "22"], "stars.csv, mag: no star with magnitude in [20, 21): choose other bins"),
    ([*BUDGET, "--bins", "0"], "--bins: must be at least 1, got 0"),
    ([*BUDGET, "--step", "0"], "--step: must be positive and finite [mag], got 0.0"),
    ([*BUDGET, "--step", "1e-9"], "--step: must make at most 200 bins"),
    ([*BUDGET, "--bins", "2", "--step", "1"], "--bins: cannot be given together with --step, got 2"),
    ([*BUDGET, "--plot", "x.xyz", "-o", "y.ecsv"], "plot: must end in .png, .pdf, .svg, got x.xyz"),
    ([*BUDGET, "--plot", "nowhere/x.png", "-o", "y.ecsv"], "output: cannot be written (No such folder)"),
    (["paper", "-o", "out", "--seed", "-1"], "seed: must be greater than or equal to 0, got -1"),
    (["paper", "-o", "out", "--psf", "psf9"], "psf: must be one of psf0, psf1, psf2"),
    (["paper", "-o", "out", "--n-stars", "0"], "n_stars: must be greater than or equal to 1, got 0"),
    (["report", "absent.zarr", "-o", "x.html"], "absent.zarr: is not a run of porrima simulate"),
    (["report", "{stars}", "-o", "x.html", "--bins", "0"], "--bins: must be at least 1, got 0"),
    (["bench", "--seed", "-1"], "seed: must be greater than or equal to 0, got -1"),
    ([*GALAXY, "--mag", "0", "inf"], "mag must be [lo, hi) with lo < hi, within -50 to 50"),
    (["simulate", "{config}", "-o", "x" * 300], "output: cannot be written (File name too long)"),
    ([*PREDICT, "--band", "J"], "band must be one of"),
    ([*GALAXY, "--band", "J"], "band must be one of"),
    (["predict", "--stars", "{stars}", "--psf", "psf1"], "--mag"),
    (["measure", "{pairs}", "--psf", "psf1"], "pairs.csv, row 2, column flux_ratio: must be in [0, 1], got 2"),
    (["measure", "{wide}", "--psf", "psf1"], "use --method images"),
    (["measure", "{wide}", "--psf", "psf1", "--estimator", "gaussian:x"], "estimator"),
    (["simulate", "{config}", "-o", "nowhere/run.zarr"], "output: must lie in a folder that can be written"),
    (["simulate", "{config}"], "--output: is missing"),
    (["simulate", "{misspelt}", "-o", "run.zarr"], "n_star: is not a key (did you mean n_stars?)"),
    (["simulate", "{impossible}", "-o", "run.zarr"], "binary_fraction: must be in [0, 1], uniform or model, got 1.2"),
    (["simulate", "{none}", "-o", "run.zarr"], "n_stars: must be greater than or equal to 1, got 0"),
    (["simulate", "{unknown_psf}", "-o", "run.zarr"], "psf: must be one of psf0, psf1, psf2"),
    (["response", "--psf", "psf9"], "psf: must be one of psf0, psf1, psf2"),
    (["response", "--psf", "psf0", "--estimator", "plain:x"], "R of plain:R must be a number of arcsec"),
    (["toy", "-o", "{stars}"], "output: cannot be made"),
    (["toy", "-o", "toy", "--ellipticity", "1"], "--ellipticity: must be between 0 and 1, got 1"),
    (["summary", "absent.zarr"], "absent.zarr: is not a run of porrima simulate"),
    (["summary", "{config}"], "is not a run of porrima simulate"),
    (["paper", "-o", "{stars}"], "output: cannot be made"),
    (["predikt"], "predikt"),
    (["stars", "--bnad", "i"], "--bnad"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"), WRONG, ids=lambda v: " ".join(v)[:60] if isinstance(v, list) else ""
)
def test_wrong_input_gives_one_line_and_writes_nothing(
    porrima, tmp_path, monkeypatch, stars_file, arguments, message
):
    files = {
        "missing_column": ("missing.csv", "mass,magnitude\n0.5,18.5\n"),
        "truncated": ("truncated.csv", "mass,distance,magnitude\n0.5,100,18.5\n0.5,10"),
        "nan_mass": ("nan.csv", "mass,distance,magnitude\n0.5,100,18.5\nnan,100,18.5\n"),
        "negative": ("negative.csv", "mass,distance,magnitude\n0.5,-100,18.5\n"),
        "pairs": ("pairs.csv", "flux_ratio,dx,dy\n2,0,0\n"),
        "wide": ("wide.csv", "flux_ratio,dx,dy\n1,0.1,0\n"),
        "typo": ("typo.yaml", "sigma_e: 2e-4\nsigma_r: 1e-3\n"),
        "nothing": ("nothing.yaml", "name: nothing\n"),
        "broken": ("broken.yaml", "sigma_e: [1\n"),
        "below": ("below.yaml", "m: -1\n"),
        "no_galaxies": ("no_galaxies.csv", "half_light_radius\n"),
        "small": ("small.csv", "half_light_radius\n0.3\n-0.1\n"),
        "config": ("run.yaml", CONFIG.format(stars=stars_file)),
        "misspelt": ("misspelt.yaml", CONFIG.format(stars=stars_file).replace("n_stars", "n_star")),
        "impossible": ("impossible.yaml", CONFIG.format(stars=stars_file) + "binary_fraction: 1.2\n"),
        "none": ("none.yaml", CONFIG.format(stars=stars_file).replace("n_stars: 10", "n_stars: 0")),
        "unknown_psf": ("unknown.yaml", CONFIG.format(stars=stars_file) + "psf: psf9\n"),
    }
    for name, text in files.values():
        (tmp_path / name).write_text(text)
    names = {key: str(tmp_path / name) for key, (name, _) in files.items()} | {"stars": str(stars_file)}
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    code, out, err = porrima(*(argument.format(**names) for argument in arguments))
    lines = [line for line in err.splitlines() if line.startswith("error: ")]
    assert code == 2
    assert out == ""
    assert len(lines) == 1
    assert message in lines[0]
    assert err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_help_needs_nothing_heavy():
    code = "import sys, typer, porrima.cli; typer.main.get_command(porrima.cli.app); print(*sys.modules)"
    modules = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {"numpy", "numba", "galsim", "astropy", "xarray", "matplotlib"} & set(modules)


@pytest.mark.parametrize(
    "command",
    ["stars", "measure", "response", "toy", "predict", "simulate", "summary", "report", "paper", "bench"],
)
def test_every_command_has_help_and_json(porrima, command):
    code, out, _ = porrima(command, "--help")
    assert code == 0
    assert "--json" in out


def test_an_interruption_is_not_wrong_input(porrima, monkeypatch, config, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("porrima.simulation.simulate", interrupted)
    code, _, err = porrima("simulate", config, "-o", tmp_path / "run.zarr")
    assert code == 1
    assert "error: interrupted" in err


def test_an_interruption_that_is_lost_in_a_callback_comes_again(porrima, monkeypatch, config, tmp_path):
    class Deaf:
        def __del__(self):
            raise KeyboardInterrupt

    def loading(*_, **__):
        del [Deaf()][0]
        time.sleep(10)

    monkeypatch.setattr("porrima.simulation.simulate", loading)
    start = time.monotonic()
    code, _, err = porrima("simulate", config, "-o", tmp_path / "run.zarr")
    assert (code, err) == (1, "error: interrupted; --resume goes on with a run\n")
    assert time.monotonic() - start < 5


def test_a_run_that_had_to_stop_is_not_wrong_input(porrima, monkeypatch, config, tmp_path):
    def stopped(*_, **__):
        raise RunError("run.zarr: cannot be written (No space left on device)")

    monkeypatch.setattr("porrima.simulation.simulate", stopped)
    code, out, err = porrima("simulate", config, "-o", tmp_path / "run.zarr")
    assert (code, out, err) == (1, "", "error: run.zarr: cannot be written (No space left on device)\n")


@pytest.mark.parametrize(
    ("selection", "message"),
    [
        ("{detection: euclid}", "selection.detection: must be 'euclid-vis' or 'roman-h158', got euclid"),
        ("[{gaia: dr3}, {clp: 1}]", "selection.1.clp: is not a key (did you mean clip?)"),
        ("[{gaia: dr3", "--selection: must be a file, {clip: value, key: value} or a list of such"),
        ("{detection: euclid-vis, psf: psf7}", "psf: must be one of psf0, psf1"),
    ],
)
def test_a_wrong_selection_ends_in_one_line(porrima, stars_file, selection, message):
    given = ("--catalog", stars_file, "--mag", 18, 19, "--selection", selection)
    for command in (("predict", "--psf", "psf0"), ("budget", "--instrument", "kcm16")):
        code, out, err = porrima(*command, *given)
        assert (code, out) == (2, "")
        assert err.count("\n") == 1
        assert message in err


def test_budget_and_correction_are_of_the_stars_that_a_selection_keeps(porrima, stars_file, tmp_path):
    patches = tmp_path / "patches.csv"
    patches.write_text("r2,n_stars\n6.785e-3,2000\n")
    chosen = "[{clip: 0.01}, {gaia: dr3}]"
    given = ("--catalog", stars_file, "--mag", 18, 19, "--selection", chosen, "--json")
    known = json.loads(porrima("predict", "--psf", "psf1", *given)[1])
    found = json.loads(porrima("budget", "--instrument", "kcm16", *given)[1])
    assert found["bins"][0]["eta"] == pytest.approx(known["eta"], rel=1e-9)
    assert {row["widest_cut"] for row in found["verdicts"]} == {None}
    result = json.loads(porrima("correct", patches, "--instrument", "kcm16", *given)[1])
    assert result["populations"][0]["eta"] == pytest.approx(known["eta"], rel=1e-9)
    assert [list(one) for one in result["configuration"]["selection"]] == [["clip"], ["gaia"]]
    code, _, err = porrima("correct", patches, "--instrument", "kcm16", "--method", "fields", *given)
    assert code == 2
    assert "--selection: goes with --method predict alone" in err
