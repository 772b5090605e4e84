"""`tom doctor` on this machine, and on a store in a bad way."""

import json
from pathlib import Path

import pytest

from tom.cli import doctor, main

TRAIN = ["train", "--env", "inverted-pendulum", "--learner", "mle", "--preset", "smoke"]


def examined(store: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, dict]]:
    capsys.readouterr()
    code = main(["doctor", "--json", "--store", str(store)])
    return code, {found["check"]: found for found in json.loads(capsys.readouterr().out)}


def test_a_machine_that_runs_the_tests_is_healthy(tmp_path: Path, capsys):
    code, found = examined(tmp_path / "new", capsys)
    assert code == 0
    assert {f["state"] for f in found.values()} <= {"ok", "note"}
    assert found["store"]["state"] == "note"
    assert not (tmp_path / "new").exists()


def test_a_damaged_run_is_named_with_its_fix(tmp_path: Path, capsys):
    run = [*TRAIN, "--no-rerun", "--steps", "50", "--store", str(tmp_path), "--run-id", "mine"]
    assert main(run) == 0
    (tmp_path / "mine/status.json").write_text("{")
    (tmp_path / "photos").mkdir()
    code, found = examined(tmp_path, capsys)
    assert code == 1
    assert "mine" in found["store"]["text"]
    assert "photos" in found["store"]["text"]
    assert "tom runs repair" in found["store"]["fix"]


def test_a_package_of_another_version_is_named():
    assert doctor.unmet("numpy>=2.0") is None
    assert doctor.unmet("numpy<1") == f"numpy {__import__('numpy').__version__} is not <1"
    assert doctor.unmet("no-such-package>=1") == "no-such-package is missing"
    assert doctor.unmet('no-such-package; extra == "bench"') is None


def test_a_check_that_breaks_is_a_finding(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(doctor.CHECKS, "gpu", lambda _: 1 / 0)
    assert doctor.check("gpu", Path()).state == "bad"
