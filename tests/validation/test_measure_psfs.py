"""Shapes from kernel moments against drawn images, behind optical, Roman, file and Gaussian PSFs."""

import warnings

import galsim
import galsim.roman
import numpy as np
import pytest

from data_files import data_file
from porrima.images import draw_stack, measure_stack
from porrima.psf import PSFS, psf_from_name
from porrima.psf_files import PSFWarning
from porrima.response import response
from porrima.shapes import Adaptive
from porrima.systems import Systems

MEASURE = (
    "10 Shapes from moments behind any PSF: stacks drawn with GalSim (0.1/12 arcsec per pixel or finer) and measured "
    "with its HSM (precision 1e-10, ended in float64), against shapes from kernel moments.  Random tables of stars, "
    "35 % of them and all of them pairs with r < 0.05 arcsec.  Largest difference of the changes of e1, e2 and "
    "R²/R0², over the size change that the images give."
)
DRAWING = (
    "10b How finely GalSim's own profiles must be drawn: GalSim's object itself, a quintic through its samples, drawn "
    "coarsely and finely and measured with HSM, against Porrima's shapes from moments; largest difference over the "
    "size change, five tables of five stars with one or two pairs.  Porrima does not move: the kinks of the quintic "
    "spoil sums over coarse pixels, differently for each place of a star in its pixel."
)
PATTERN = (
    "10c What GalSim's quintic does to Roman's PSFs: `galsim.roman` samples its diffraction pattern at half of "
    "lambda/D; `roman` is the quintic through these samples, as GalSim draws it, `roman-exact` the pattern itself.  "
    "Adaptive R² without companions and kappa, bare and behind a pixel of 0.11 arcsec."
)
SINGLE = Systems.from_pairs(np.zeros(1), np.zeros(1), np.zeros(1))
TABLES = [
    (1, 1.0, 4),
    (5, 0.35, 4),
    (5, 1.0, 4),
    (40, 0.35, 3),
    (40, 1.0, 3),
    (1000, 0.35, 1),
    (1000, 1.0, 1),
]
PSFS_DRAWN = {  # what is shown: name, options
    **{name: (name, {}) for name in PSFS},
    "psf1, pixel 0.1": ("psf1", {"pixel": 0.1}),
    "optical0": ("optical0", {}),
    "optical1": ("optical1", {}),
    "optical1-rotated": ("optical1-rotated", {}),
    "optical2, jitter 0.08, pixel 0.1": ("optical2", {"jitter": 0.08, "pixel": 0.1}),
    "roman:H158:SCA01": ("roman:H158:SCA01", {}),
    "roman-exact:Y106:SCA09": ("roman-exact:Y106:SCA09", {}),
    "roman:F184:SCA18:0,4088, pixel 0.11": ("roman:F184:SCA18:0,4088", {"pixel": 0.11}),
    "VIS-like, 0.1″ (FITS)": ("euclid_vis_like_1x.fits", {"pixel_scale": 0.1}),
    "VIS-like, 0.033″ (FITS)": ("euclid_vis_like_3x.fits", {"pixel_scale": 0.1 / 3}),
    "ACS F814W (FITS)": ("hst_acs_f814w.fits", {"pixel_scale": 0.03}),
    "Euclid-like field, plane 7 (FITS)": ("euclid_like_field_100.fits[0,7]", {"pixel_scale": 0.1}),
}


def opened(name, options):
    if ".fits" in name:
        file, bracket, part = name.partition("[")
        name = f"{data_file(f'psf/{file}')}{bracket}{part}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        return psf_from_name(name, **options)


def random_pairs(rng, n, share):
    f = rng.random(n) * (rng.permutation(n) < round(share * n))
    r, angle = 0.05 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    return Systems.from_pairs(f, r * np.cos(angle), r * np.sin(angle))


def values(shape):
    assert np.all(shape.flag == 0)
    return np.squeeze(np.array([shape.e1, shape.e2, shape.r2]))


def change(stack, single):
    return np.array([stack[0] - single[0], stack[1] - single[1], stack[2] / single[2] - 1])


def by_moments(psf, systems):
    reply = response(psf, Adaptive())
    return change(*(values(reply.shapes(s.kernel_moments())) for s in (systems, SINGLE)))


@pytest.mark.parametrize("shown", PSFS_DRAWN)
def test_shapes_from_moments_are_those_of_drawn_stacks(record, full_size, shown):
    name, options = PSFS_DRAWN[shown]
    psf = opened(name, options)
    rng = np.random.Generator(np.random.Philox(key=(8, list(PSFS_DRAWN).index(shown))))
    alone, worst, smallest = values(measure_stack(psf, SINGLE, Adaptive())), {}, np.inf
    for n, share, n_tables in TABLES:
        for _ in range(n_tables if full_size else 1):
            systems = random_pairs(rng, n, share)
            drawn = change(values(measure_stack(psf, systems, Adaptive())), alone)
            difference = np.abs(by_moments(psf, systems) - drawn).max() / drawn[2]
            worst[n], smallest = max(worst.get(n, 0.0), difference), min(smallest, drawn[2])
    columns = ["PSF", *(f"{n} stars" for n in worst), "smallest size change"]
    record(MEASURE, columns, [shown, *(f"{value:.0e}" for value in worst.values()), f"{smallest:.1e}"])
    assert max(worst.values()) < (1e-4 if name in PSFS else 1e-3)


@pytest.mark.parametrize("name", ["psf2", "optical1", "roman:H158:SCA01"])
def test_hsm_as_it_stands_differs_by_its_float32_only(name):
    psf = psf_from_name(name)
    image = draw_stack(psf, random_pairs(np.random.Generator(np.random.Philox(80)), 40, 0.35))
    parameters = galsim.hsm.HSMParams(convergence_threshold=1e-10, max_amoment=1e6)
    raw = galsim.hsm.FindAdaptiveMom(image, precision=1e-10, hsmparams=parameters)
    ended = Adaptive().measure(image)
    e1, e2 = raw.observed_shape.e1, raw.observed_shape.e2
    r2 = 2 * (raw.moments_sigma * image.scale) ** 2 / np.sqrt(1 - e1**2 - e2**2)
    assert (e1, e2) == pytest.approx((float(ended.e1), float(ended.e2)), abs=1e-7)
    assert r2 == pytest.approx(float(ended.r2), rel=4e-7)


def galsims_own(shown):
    """The object as GalSim makes it, and the name by which Porrima knows it."""
    if shown.startswith("roman"):
        band = galsim.roman.getBandpasses()["H158"]
        return galsim.roman.getPSF(1, "H158", wavelength=band), "roman:H158:SCA01"
    pixels = galsim.fits.read(str(data_file("psf/euclid_vis_like_1x.fits")), hdu=1)
    peak = np.unravel_index(np.argmax(pixels.array), pixels.array.shape)
    offset = galsim.PositionD(peak[1] + 1, peak[0] + 1) - pixels.true_center
    image = galsim.Image(pixels.array.astype(float), scale=0.1)
    return galsim.InterpolatedImage(image, x_interpolant="quintic", offset=offset), "euclid_vis_like_1x.fits"


def drawn_change(profile, systems, scale):
    """Change that HSM measures on GalSim's own drawing of GalSim's own object."""

    def measured(of):
        flux = (of.flux / len(of)).ravel()
        sources = galsim.Sum(
            [
                profile.shift(x, y) * f
                for x, y, f in zip(of.x.ravel(), of.y.ravel(), flux, strict=True)
                if f > 0
            ]
        )
        size = 2 * round(0.7 / scale) + 1
        return values(
            Adaptive().measure(
                sources.drawImage(nx=size, ny=size, scale=scale, method="no_pixel", dtype=float)
            )
        )

    return change(measured(systems), measured(SINGLE))


@pytest.mark.parametrize("shown", ["roman:H158:SCA01", "VIS-like, 0.1″ (FITS)"])
def test_galsims_own_profiles_drawn_finely_give_the_shapes_from_moments(record, shown):
    profile, name = galsims_own(shown)
    psf = opened(name, {"pixel_scale": 0.1} if name.endswith("fits") else {})
    rng = np.random.Generator(np.random.Philox(key=(81, 0)))
    worst = dict.fromkeys((12, 24, 48), 0.0)
    for _ in range(5):
        systems = random_pairs(rng, 5, 0.35)
        quick = by_moments(psf, systems)
        for n in worst:
            drawn = drawn_change(profile, systems, 0.1 / n)
            worst[n] = max(worst[n], np.abs(quick - drawn).max() / drawn[2])
    record(
        DRAWING,
        ["PSF", *(f"0.1/{n} arcsec per pixel" for n in worst)],
        [shown, *(f"{v:.0e}" for v in worst.values())],
    )
    assert worst[48] < 1e-3
    assert worst[48] < worst[12] / 3


@pytest.mark.parametrize("band", ["Y106", "J129", "H158", "F184"])
def test_how_much_galsims_interpolation_widens_a_roman_psf(record, band):
    results = []
    for kind, options in (
        ("roman", {}),
        ("roman-exact", {}),
        ("roman", {"pixel": 0.11}),
        ("roman-exact", {"pixel": 0.11}),
    ):
        reply = response(psf_from_name(f"{kind}:{band}:SCA01", **options), Adaptive())
        results += [float(reply.shape0.r2), reply.kappa_r2]
    columns = ["band", "R², roman", "kappa", "R², roman-exact", "kappa"]
    columns += ["R², roman, pixel", "kappa", "R², roman-exact, pixel", "kappa"]
    shown = [f"{v:.4e}" if n % 2 == 0 else f"{v:.3f}" for n, v in enumerate(results)]
    record(PATTERN, columns, [band, *shown])
    assert 1.03 < results[0] / results[2] < 1.06
    assert 1.06 < results[1] / results[3] < 1.12
    assert 0.97 < results[5] / results[7] < 1.03
