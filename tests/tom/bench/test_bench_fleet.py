"""`tom bench fleet`: it runs each part as trainings do; no time of it is looked at."""

import json

import pytest
import torch
from gpus import emulated

from tom.bench import fleet
from tom.bench.fleet import ADD, ALONE, EAGER, ENV, MDN, ROLLOUT, SAC, WEIGHTS, Measured, Sizes
from tom.cli import main
from tom.config import TomConfig

SMALL = Sizes(
    updates=10,
    mdn_steps=5,
    tom=TomConfig.preset("paper").but(warmup=1, discriminator_steps=5, q_steps=6),
    rows=600,
    starts=200,
)
PARTS = [EAGER, ALONE, SAC, MDN, WEIGHTS, ROLLOUT, ENV, ADD]


def test_every_part_is_measured_for_all_members():
    rows = fleet.measure(torch.device("cpu"), 2, 1, SMALL)
    assert [row.part for row in rows] == PARTS
    assert [row.members for row in rows] == [1, 1, 2, 2, 2, 1, 2, 2]
    for row in rows:
        assert row.low_ms <= row.ms <= row.high_ms
        assert row.per_second == pytest.approx(1000 / row.ms)
        assert row.member_per_second == pytest.approx(row.members * row.per_second)


def test_on_a_gpu_what_trains_is_captured_and_the_eager_loop_is_not():
    with emulated() as gpus:
        fleet.measure(torch.device("cuda"), 2, 1, SMALL)
    # The first 3 calls of a capture run eagerly: of 30 SAC updates each, 27 are replays.
    mdn = 3 * SMALL.mdn_steps - 3
    weighed = 3 * (SMALL.tom.discriminator_steps - 3 + SMALL.tom.q_steps - 3)
    assert gpus.launches["replay"] == 2 * 27 + mdn + weighed


def test_minutes_are_of_the_papers_hopper():
    def row(part: str, ms: float, members: int = 4) -> Measured:
        return Measured(part, members, ms, ms, ms, 0.0, 0.0, None)

    none = [row(part, 0.0) for part in PARTS]

    def alone(part: str) -> float:
        return fleet.minutes([row(part, 6.0) if r.part == part else r for r in none])

    steps, fits = 120_000, 480
    assert alone(SAC) == pytest.approx(steps * 5 * 6 / 60_000)
    assert alone(ENV) == alone(ADD) == pytest.approx(steps * 6 / 60_000)
    assert alone(MDN) == pytest.approx(fits * 3000 * 6 / 60_000)
    assert alone(WEIGHTS) == pytest.approx(fits * 6 / 60_000)
    assert alone(ROLLOUT) == pytest.approx(4 * fits * 6 / 60_000)
    assert alone(EAGER) == alone(ALONE) == 0


def test_the_command_prints_one_document(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr(fleet, "Sizes", lambda: SMALL)
    words = ["bench", "fleet", "--device", "cpu", "--members", "2", "--repeats", "1", "--json"]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["part"] for row in found["parts"]] == PARTS
    assert found["minutes"] > 0


def test_a_fleet_of_none_is_refused(capsys):
    assert main(["bench", "fleet", "--device", "cpu", "--members", "0"]) == 2
    assert "--members must be at least 1" in capsys.readouterr().err


def test_large_times_are_written_out(monkeypatch: pytest.MonkeyPatch, capsys):
    rows = [Measured(part, 2, 32_960.4, 1.0, 1.0, 0.03034, 1.0, None) for part in PARTS]
    monkeypatch.setattr(fleet, "measure", lambda *_: rows)
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["bench", "fleet", "--device", "cpu", "--members", "2"]) == 0
    said = capsys.readouterr().out
    assert "32,960" in said
    assert "0.03034" in said
