r"""What a clip leaves of stars that are measured with noise: the stars kept, their mean shape and its scatter.

A star with the own change u and the noise n of its size is kept where u + n does not exceed t.  So the clip cuts the
noise, too: of those kept, the mean of n is :math:`-\sigma^2 K'(t)/K(t)` with the share K that is kept, which makes the
PSF too small where stars are faint.  A clip from both sides has no such mean but that of pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.special import ndtr

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.own_sizes import OwnSizes

    FloatArray = NDArray[np.float64]

__all__ = ["SIDES", "KeptShapes", "Sides", "kept_shapes"]

Sides = Literal["both", "upper"]
"""Whether stars that look too small are clipped as well."""

SIDES = ("both", "upper")
"""All of `Sides`."""

_SHARP = 0.01  # width of the edge of a clip without noise, over the threshold: half of a node of the change of size


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptShapes:
    r"""Stars that clips of k thresholds keep; shapes are changes of e1, e2 and R² over R0², dimensionless.

    Parameters
    ----------
    share : (k,) float array
        Stars kept of all, resolved pairs counted in, in [0, 1].
    false_rejections : (k,) float array
        Share of the stars without an own change that is rejected, in [0, 1].
    mean_x : (k,) float array
        :math:`\langle x \rangle` of those kept, in arcsec².
    binaries, clip : (k, 3) float array
        Mean change by companions, and mean noise that the clip leaves.
    scatter, noise : (k, 3) float array
        Variance of what one star adds to a stack: by companions, and all the rest, which the clip correlates with it.
    follows : (k,) float array
        By how much the mean size of those kept follows what the clip is centred on, dimensionless: 0 without a clip,
        near 1 where it cuts into the noise.
    """

    share: FloatArray
    false_rejections: FloatArray
    mean_x: FloatArray
    binaries: FloatArray
    clip: FloatArray
    scatter: FloatArray
    noise: FloatArray
    follows: FloatArray


def kept_shapes(
    sizes: OwnSizes,
    covariance: FloatArray,
    threshold: FloatArray,
    sides: Sides = "both",
    independent: bool = False,
) -> KeptShapes:
    r"""What clips of some thresholds leave of stars measured with noise.

    Parameters
    ----------
    sizes : OwnSizes
        Of a population.
    covariance : (n_m, 3, 3) float array
        Of the noise of one star's e1, e2 and R² over R0² in each group of magnitude, dimensionless.
    threshold : (k,) float array
        Largest measured :math:`\delta R^2/R_0^2`, positive, dimensionless; infinite for no clip.
    sides : {"both", "upper"}
        Whether :math:`-\delta R^2/R_0^2` must not exceed it either.
    independent : bool
        Whether the noise of what is clipped is another one, as large, than that of what is stacked.

    Returns
    -------
    kept : KeptShapes
        Dimensionless.

    Notes
    -----
    With z = (u - t)/τ, :math:`\tau^2 = \sigma^2 + s^2` (s: what u scatters by with position angle), the normal law Φ
    and its density φ, a star is kept with probability Q = Φ(-z) and

    .. math:: E[n;\ \mathrm{kept}] = -\frac{\sigma^2}{\tau} \varphi(z), \qquad
              E[n^2;\ \mathrm{kept}] = \sigma^2 Q + \frac{\sigma^4}{\tau^2} z\, \varphi(z) .

    **Where the clip is centred.**  If its centre moves by c, so do its edges, and the mean size M of those kept moves
    by M' c with

    .. math:: M' = \frac{1}{K}\Big(\frac{dA}{dt} - M \frac{dK}{dt}\Big), \qquad
              \frac{dK}{dt} = \sum \frac{\varphi(z)}{\tau}, \quad
              \frac{dA}{dt} = \sum \Big(g - \sigma^2 \frac{z}{\tau}\Big) \frac{\varphi(z)}{\tau}

    for the sum A of what is kept, summed over both edges.  A clip that is centred on the mean of the stars that it
    keeps finds a size that is off by M/(1 - M'), with the variance of M over (1 - M')².  Without that, a clip into the
    noise would seem to lower it.

    A clip from both sides keeps what that at t keeps less what that at -t keeps.  The noise of e1 and e2 follows that
    of the size by their correlation, and is free otherwise.  Gaussian noise; exact otherwise but for groups of
    magnitude, some 0.3 % of the sums.
    """
    plus = _sums(sizes, covariance, threshold, threshold, independent)
    if sides == "both":
        minus = _sums(sizes, covariance, -threshold, threshold, independent)
        plus = {name: value - minus[name] for name, value in plus.items()}
    kept = np.maximum(plus["number"], 1e-300)
    mean = {name: plus[name] / (kept if plus[name].ndim == 1 else kept[:, None]) for name in plus}
    scatter = mean["squared"] - mean["added"] ** 2
    noise = mean["noise2"] + 2 * (mean["product"] - mean["added"] * mean["noise"]) - mean["noise"] ** 2
    at_zero = plus["number0"] / max(float(sizes.number[:, 0].sum()), 1e-300)
    return KeptShapes(
        share=plus["number"] / sizes.total,
        false_rejections=np.clip(1 - at_zero, 0.0, 1.0),
        mean_x=mean["x"],
        binaries=mean["added"],
        clip=mean["noise"],
        scatter=scatter,
        noise=noise,
        follows=mean["moving"] - (mean["added"] + mean["noise"])[:, 2] * mean["edge"],
    )


def _sums(
    sizes: OwnSizes, covariance: FloatArray, edge: FloatArray, width: FloatArray, independent: bool
) -> dict[str, FloatArray]:
    """Sums over the stars that lie below each edge: of one, x, what they add, their noise and the products of both."""
    variance = covariance[:, 2, 2]
    slope = np.divide(
        covariance[:, 2], variance[:, None], out=np.zeros_like(covariance[:, 2]), where=variance[:, None] > 0
    )
    rest = np.einsum("mqq->mq", covariance) - slope**2 * variance[:, None]
    finite = np.isfinite(edge)
    t, w = np.where(finite, edge, 0.0), np.where(finite, width, 1.0)
    s2, sigma2 = np.square(sizes.spread)[:, None], variance[:, None, None]
    tau2 = sigma2 + np.maximum(s2, np.square(_SHARP * w)[:, None])
    z = (sizes.change - t[:, None]) / np.sqrt(tau2)  # (m, k, u)
    z[:, ~finite] = -np.inf
    z[:, edge == -np.inf] = np.inf
    kept = ndtr(-z)
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    noise = np.zeros_like(z) if independent else -sigma2 / np.sqrt(tau2) * density
    skew = np.where(density > 0, z, 0.0) * density
    noise2 = sigma2 * kept + (0.0 if independent else sigma2**2 / tau2 * skew)

    def over_stars(weight: FloatArray, values: FloatArray, factor: FloatArray | None = None) -> FloatArray:
        by_group = np.einsum("mu...,mku->mk...", weight, values, optimize=True)
        return np.asarray((by_group if factor is None else by_group[..., None] * factor[:, None]).sum(axis=0))

    of_all = np.einsum("mu,mku->mk", sizes.number, kept, optimize=True)
    product = np.einsum("muq,mku,mq->kq", sizes.added, noise, slope, optimize=True)
    edges = density / np.sqrt(tau2)
    moved = 0.0 if independent else -sigma2 * skew / tau2
    return {
        "edge": np.einsum("mu,mku->k", sizes.number, edges, optimize=True),
        "moving": np.einsum("mu,mku->k", sizes.added[..., 2], edges, optimize=True)
        + np.einsum("mu,mku->k", sizes.number, np.broadcast_to(moved, edges.shape), optimize=True),
        "number": of_all.sum(axis=0),
        "number0": np.einsum("m,mk->k", sizes.number[:, 0], kept[:, :, 0]),
        "x": over_stars(sizes.x, kept),
        "added": over_stars(sizes.added, kept),
        "squared": over_stars(sizes.squared, kept),
        "noise": over_stars(sizes.number, noise, slope),
        "noise2": over_stars(sizes.number, noise2, slope**2) + np.einsum("mk,mq->kq", of_all, rest),
        "product": product,
    }
