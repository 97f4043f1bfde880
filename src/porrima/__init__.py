"""Porrima: what unresolved binary stars do to the PSF of a weak-lensing survey."""

__version__ = "0.1.0"
