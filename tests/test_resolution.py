import galsim
import numpy as np
import pytest

from porrima.galaxies import Galaxies
from porrima.psf import psf_from_name
from porrima.resolution import seen_by_regauss


@pytest.fixture(scope="module")
def psf():
    return psf_from_name("psf0")


def test_gaussian_galaxies_keep_their_size(psf):
    galaxies = Galaxies.of(np.array([0.01, 0.1]))
    assert seen_by_regauss(galaxies, psf) is galaxies


def test_a_nearly_gaussian_galaxy_nearly_keeps_it(psf):
    galaxies = Galaxies.sersic(0.1, 0.51)
    np.testing.assert_allclose(seen_by_regauss(galaxies, psf).r2, galaxies.r2, rtol=0.03)


def test_cusps_and_wings_look_smaller(psf):
    seen = [
        seen_by_regauss(Galaxies.sersic(0.2, n), psf).r2[0] / Galaxies.sersic(0.2, n).r2[0]
        for n in (1.0, 2.0, 4.0)
    ]
    assert 1 > seen[0] > seen[1] > seen[2] > 0


def test_the_response_to_shear_is_that_of_the_size(psf):
    """REGAUSS of a galaxy with a PSF a little too wide: its ellipticity grows by x over the size that is seen."""
    radius, index, e, x = 0.2, 1.0, 0.05, 2e-5
    seen = seen_by_regauss(Galaxies.sersic(radius, index), psf).r2[0]
    params = galsim.hsm.HSMParams(nsig_rg=10, nsig_rg2=10)
    galaxy = galsim.Convolve(galsim.Sersic(index, half_light_radius=radius).shear(e1=e), psf.profile)
    sigma = galsim.Gaussian(fwhm=0.137).sigma
    wide = galsim.Gaussian(sigma=np.sqrt(sigma**2 + x / 2))
    draw = {"nx": 151, "ny": 151, "scale": 0.02, "method": "no_pixel", "dtype": float}
    image = galaxy.drawImage(**draw)
    found = [
        galsim.hsm.EstimateShear(
            image, p.drawImage(**draw), shear_est="REGAUSS", hsmparams=params, precision=1e-9
        )
        for p in (psf.profile, wide)
    ]
    change = found[1].corrected_e1 / found[0].corrected_e1 - 1
    assert change == pytest.approx(x / seen, rel=0.06)


def test_many_sizes_are_interpolated(psf):
    galaxies = Galaxies.log_normal(0.1, 0.2, smallest_r2=0.03, index=1.0)
    seen = seen_by_regauss(galaxies, psf)
    one = Galaxies.of(galaxies.r2[20], index=1.0)
    assert seen.r2[20] == pytest.approx(seen_by_regauss(one, psf).r2[0], rel=1e-3)
    assert np.all(seen.weight == galaxies.weight)
