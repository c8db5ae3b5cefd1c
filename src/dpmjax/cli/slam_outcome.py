"""What a SLAM run leaves: the state after the last scan, the reports, seconds, and what ended it early."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from dpmjax.slam import ScanReport, SlamState


class SlamRun(NamedTuple):
    """A run until its end or its stop.

    Attributes:
        state: after the last scan.
        reports: of all scans.
        stages_s: seconds of each stage in this process, without compilation.
        compile_s: seconds of compilation.
        run_s: seconds of all scans of this process, without compilation.
        scan_s: seconds of each scan of this process, without compilation, reading and writing.
        failure: what ended the run early; None where nothing did.
    """

    state: SlamState
    reports: tuple[ScanReport, ...]
    stages_s: dict[str, float]
    compile_s: float
    run_s: float
    scan_s: tuple[float, ...]
    failure: Exception | None

    @property
    def num_done(self) -> int:
        """Number of scans of this process."""
        return len(self.scan_s)
