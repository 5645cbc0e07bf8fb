import numpy as np
import pytest

from unghost.core.schedule import alphas_cumprod, betas, check_timestep, timestep_from_severity


def test_the_papers_schedule():
    assert len(betas()) == 1000
    assert betas()[0] == 0.0015
    assert betas()[-1] == 0.05
    assert alphas_cumprod()[1] == pytest.approx((1 - betas()[0]) * (1 - betas()[1]))
    assert (np.diff(alphas_cumprod()) < 0).all()


def test_severity_spans_the_timesteps():
    assert timestep_from_severity([0.0, 0.5, 1.0]).tolist() == [0, 500, 999]
    for wrong in (-0.1, 1.1, np.nan):
        with pytest.raises(ValueError, match="severity must lie in"):
            timestep_from_severity(wrong)


def test_timesteps_are_integers_in_range():
    assert check_timestep(np.int32(999), caller="f").dtype == np.int64
    assert check_timestep(np.zeros(0, dtype=int), caller="f").shape == (0,)
    with pytest.raises(TypeError, match="f: timestep must be an integer, got dtype float64"):
        check_timestep(3.0, caller="f")
    for wrong in (-1, 1000):
        with pytest.raises(ValueError, match="f: timestep must lie in"):
            check_timestep([0, wrong], caller="f")
