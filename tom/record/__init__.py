"""The record of a run: files hold all of it, Rerun is only a view. It never slows training.

This package exports the reading of runs. The modules that write (`recorder`, `writer`,
`rerun.sink`) are imported separately, so that a reader does not load them.
"""

from tom.record.reader import RunReader
from tom.record.status import Status
from tom.record.store import Store

__all__ = ["RunReader", "Status", "Store"]
