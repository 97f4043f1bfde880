"""The figure of what surveys recognise of pairs: its numbers, and that it is written."""

import numpy as np

from porrima.detection import Detection
from porrima.detection_figure import detection_maps
from porrima.exposure import EUCLID_VIS_WIDE
from porrima.psf import psf_from_name
from porrima.recognition import recognition_maps, write_recognition


def test_maps_are_of_all_exposures_behind_the_surveys_psf():
    maps = recognition_maps((20.0,), 4, 3)
    assert maps["probability"].shape == (2, 1, 3, 4)
    vis = Detection.of(psf_from_name("optical1", pixel=0.1, jitter=0.029), EUCLID_VIS_WIDE)
    c, r = np.meshgrid(maps["contrast"], maps["separation"], indexing="ij")
    found = maps["probability"].sel(survey="Euclid VIS", magnitude=20.0)
    assert np.array_equal(found, vis.rejected(r, 10 ** (-0.4 * c), np.array(20.0)))
    assert np.all(np.diff(found, axis=1) > -1e-6)


def test_the_figure_is_written(monkeypatch, tmp_path):
    few = recognition_maps((20.0,), 6, 5)
    assert detection_maps(few).axes[0].get_title() == "Euclid VIS, 20 mag"
    monkeypatch.setattr("porrima.recognition.recognition_maps", lambda: few)
    assert write_recognition(tmp_path).stat().st_size > 1000
