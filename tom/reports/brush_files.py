"""The files of a brushed region: a weighing, with the models' errors and ghosts."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tom.analysis.brush import AS_IT_IS, BrushedFit
from tom.analysis.progression import progression
from tom.record.decode import write_table
from tom.record.files import replace_json
from tom.reports.weighing_files import REPORT, WEIGHTS, whole_weighing

GHOSTS = "ghosts.npz"
REGION = "region"
"""the column that marks the brushed rows"""


def called(factor: float) -> str:
    """The name of weights of that factor, used in place of a learner's name."""
    return "as it is" if factor == AS_IT_IS else f"region x {factor:g}"


def write(
    out: Path,
    region: NDArray[np.bool_],
    models: Sequence[BrushedFit],
    report: dict[str, Any],
    ghosts: Mapping[str, NDArray],
) -> None:
    """Make the folder `out` with all files. Raises UserError if it cannot be made."""
    # The weights do not depend on the seed.
    first = {one.factor: one for one in reversed(models)}
    columns = {f"{called(f)}-s{one.seed}": one.weights for f, one in sorted(first.items())}
    results = [
        {
            "learner": called(one.factor),
            "factor": one.factor,
            "seed": one.seed,
            "errors": one.errors,
            **progression(one.weights, report["ordered_from"]).row(),
        }
        for one in models
    ]
    with whole_weighing(out) as unfinished:
        table = pa.table({**columns, REGION: region})
        write_table(unfinished / WEIGHTS, table)
        if ghosts:
            np.savez_compressed(unfinished / GHOSTS, allow_pickle=False, **dict(ghosts))
        replace_json(unfinished / REPORT, {**report, "results": results}, sync=False)
