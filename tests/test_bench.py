import pytest

from porrima.bench import measure_speed


def test_a_benchmark_names_its_machine_and_its_ratio():
    speed = measure_speed(n_stars=20, n_stacks=200)
    assert speed.n_stars == 20
    assert "threads" in speed.machine
    threads = int(speed.machine.split(", ")[-1].split()[0])
    assert speed.ratio == pytest.approx(speed.engine_stars_per_s / speed.galsim_stars_per_s / threads)
    assert min(speed.engine_stars_per_s, speed.galsim_stars_per_s, speed.engine_with_shapes_stars_per_s) > 0
