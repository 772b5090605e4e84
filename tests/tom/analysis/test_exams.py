"""The exams of fits as pages read them: their numbers, and who is ranked."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from tom.analysis.exams import Exams, at_fit, exams_of, ranking
from tom.analysis.scores import counted_from

NAN = float("nan")


def sat(group: str, seed: int, errors: Sequence[float], every: int = 100) -> Exams:
    """A run whose fits, `every` steps, had these errors."""
    step = np.arange(1, len(errors) + 1) * every
    error, none = np.array(errors, np.float64), np.full(len(errors), NAN)
    return Exams(
        f"{group}-{seed}", group.lower(), seed, group, step, error, 2 * error,
        footprint=none, noise=none, returns=none,
    )  # fmt: skip


def test_exams_are_read_where_one_was_sat() -> None:
    frame = pd.DataFrame(
        {
            "env_step": [100, 150, 200, 300],
            "eval/return": [1.0, 2.0, NAN, 3.0],
            "exam/error": [0.5, NAN, 0.25, NAN],
            "exam/footprint": [0.8, NAN, NAN, NAN],
            "exam/footprint_uniform": [0.3, NAN, -0.01, NAN],
            "exam/footprint_noise": [-0.2, NAN, NAN, NAN],
        }
    )
    found = exams_of("a", "tom", 3, "TOM", frame)
    assert found.step.tolist() == [100, 200]
    assert found.error.tolist() == [0.5, 0.25]
    assert found.informative.tolist() == [True, False]
    assert found.returns.tolist() == [2.0, 3.0]  # not what was evaluated at the fit's own step
    assert np.isnan(found.rollout_error).all()
    assert at_fit(frame, 200) == {"exam/error": 0.25, "exam/footprint_uniform": -0.01}
    assert at_fit(frame, 150) == at_fit(frame, 7) == {}


@pytest.mark.parametrize("noise", [1.0, -1.5, NAN])
def test_a_footprint_lost_in_its_noise_says_nothing(noise: float) -> None:
    run = replace(sat("TOM", 0, [1.0]), footprint=np.array([0.1]), noise=np.array([noise]))
    assert not run.informative.any()
    [group] = ranking([run]).standings
    assert (group.informative_fits, len(group.footprint)) == (0, 0)


def test_nobody_is_ranked_under_five_seeds() -> None:
    tom = [sat("TOM", seed, [0.1]) for seed in range(5)]
    mle = [sat("MLE", seed, [0.2]) for seed in (0, 1, 2, 3, 3)]  # a seed twice is one seed
    found = ranking([*tom, *mle])
    assert found.ranked == ()
    assert [(one.name, one.seeds, len(one.error)) for one in found.standings] == [
        ("TOM", 5, 5),
        ("MLE", 4, 5),
    ]


def test_who_errs_least_comes_first_by_the_medians_of_the_runs() -> None:
    tom = [sat("TOM", seed, [0.1 + 0.01 * seed, 9.0, 0.1 + 0.01 * seed]) for seed in range(5)]
    mle = [sat("MLE", seed, [0.2 + 0.01 * seed] * 3) for seed in range(5)]
    found = ranking([*mle, *tom])
    assert [one.name for one in found.ranked] == ["TOM", "MLE"]
    assert found.ranked[0].error == pytest.approx([0.1, 0.11, 0.12, 0.13, 0.14])
    assert found.ranked[0].typical == pytest.approx(0.12)
    assert found.ranked[0].rollout_error == pytest.approx(2 * found.ranked[0].error)
    assert (found.first_beats_second.value, found.first_beats_second.low) == (1, 1)


def test_fits_from_before_every_run_weighs_do_not_count() -> None:
    warm = pd.DataFrame({"env_step": [100, 200, 300], "weights/ess": [1.0, NAN, 0.4]})
    late = pd.DataFrame({"env_step": [100, 200, 300, 400], "weights/ess": [1.0, 1.0, 1.0, 0.9]})
    even = pd.DataFrame({"env_step": [500], "weights/ess": [1.0]})
    assert counted_from([warm, even]) == 300
    assert counted_from([warm, late, pd.DataFrame({"env_step": [1]})]) == 400
    assert counted_from([even]) == counted_from([]) == -np.inf
    runs = [sat(name, 0, [0.9, 0.8, 0.2, 0.1]) for name in ("TOM", "MLE")]
    found = ranking(runs, since=300)
    assert found.since == 300
    assert [one.fits for one in found.standings] == [2, 2]
    assert [one.error.item() for one in found.standings] == pytest.approx([0.15, 0.15])
    begun = ranking([*runs, sat("PMAC", 0, [0.7])], since=300)  # it has no fit that would count
    assert begun.since == -np.inf
    assert [one.error.tolist() for one in begun.standings] == [[0.9], [0.9], [0.7]]


def test_groups_are_compared_over_the_steps_that_five_seeds_of_each_reach() -> None:
    # Errors fall as data come: who trained for longer must not win by that.
    long = [sat("TOM", seed, [0.9, 0.8, 0.1, 0.1, 0.1]) for seed in range(5)]
    short = [
        sat("MLE", seed, [0.5, 0.5, 0.5][:reach]) for seed, reach in enumerate((2, 2, 2, 2, 3))
    ]
    early = sat("MLE", 7, [0.01])
    found = ranking([*long, *short, early])
    assert found.until == 200
    assert [one.name for one in found.ranked] == ["MLE", "TOM"]
    assert [(len(one.error), one.fits) for one in found.ranked] == [(5, 10), (5, 10)]
    assert found.ranked[1].error == pytest.approx([0.85] * 5)
