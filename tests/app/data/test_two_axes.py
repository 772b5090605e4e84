"""Which studies of a folder answer a question together."""

import shutil
from pathlib import Path

from app.data import studies
from app.data.verdicts import on_two_axes

GALLERY = Path(__file__).parents[3] / "runs" / "studies"


def test_studies_whose_names_end_alike_belong_together(tmp_path: Path):
    for name, ending in (("footprint", ""), ("footprint", "-b"), ("capacity", "-b")):
        shutil.copytree(GALLERY / name, tmp_path / f"{name}{ending}")
    listed = studies.listing(tmp_path)
    assert [*on_two_axes(listed)] == ["capacity-b"]
    assert on_two_axes(listed)["capacity-b"] == on_two_axes(studies.listing(GALLERY))["capacity"]
    (tmp_path / "footprint-b" / "moments.csv").write_text("way\nuniform\n")  # of another version
    assert not on_two_axes(studies.listing(tmp_path))
