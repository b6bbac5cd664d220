import pytest

from popl_rl.evaluation.learning_curves import fit_learning_curve

ERROR = [0.001] * 4


def test_the_answers_that_are_missing_by_hand():
    """Wrong 0.1 + 4 / m: 0.02 above the floor at m = 200, 120 more than 80."""
    answers = [10, 20, 40, 80]
    curve = fit_learning_curve(answers, [0.1 + 4 / m for m in answers], ERROR)
    assert curve.floor == pytest.approx(0.1)
    assert curve.needed == pytest.approx(200, abs=1)
    assert curve.missing == curve.needed - 80
    assert curve.between[0] <= curve.needed <= curve.between[1]
    said = curve.warning(raters=10)
    assert said is not None
    assert said.startswith(f"about {curve.missing} answers are missing (")
    assert f"{-(-curve.missing // 10)} more of each rater" in said
    assert "15% are ranked wrong after learning from 80, 50% after 10, and 10% would be" in said


def test_slow_learning_misses_more():
    """Wrong 2 / sqrt(m): 0.02 at m = 10 000."""
    answers = [100, 200, 400, 800]
    curve = fit_learning_curve(answers, [2 / m**0.5 for m in answers], ERROR)
    assert curve.needed == pytest.approx(10_000, rel=0.01)


@pytest.mark.parametrize("wrong", [[0.2] * 4, [0.2, 0.21, 0.22, 0.23], [0.11, 0.105, 0.1025, 0.1]])
def test_where_answers_have_nothing_to_add_nothing_is_missing(wrong):
    curve = fit_learning_curve([100, 200, 400, 800], wrong, ERROR)
    assert curve.missing == 0
    assert curve.warning(raters=10) is None


def test_noise_widens_what_may_be_needed():
    answers, wrong = [10, 20, 40, 80], [0.5, 0.31, 0.2, 0.16]
    sure = fit_learning_curve(answers, wrong, [0.0001] * 4)
    unsure = fit_learning_curve(answers, wrong, [0.05] * 4)
    assert sure.needed == pytest.approx(unsure.needed, abs=1)
    assert unsure.between[1] - unsure.between[0] >= sure.between[1] - sure.between[0]
    assert unsure.between[1] > 2 * unsure.between[0]


@pytest.mark.parametrize(
    ("answers", "error"), [([10, 20], [0.1] * 2), ([10, 20, 20], [0.1] * 3), ([1, 2, 3], [0.0] * 3)]
)
def test_points_that_make_no_curve(answers, error):
    with pytest.raises(ValueError, match="at least three ascending numbers"):
        fit_learning_curve(answers, [0.2] * len(answers), error)
