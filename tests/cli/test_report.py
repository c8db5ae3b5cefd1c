"""The page of a run stands alone, agrees with the files, and opens in a browser without an error."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from dpmjax import io
from dpmjax.cli.report import write_report
from tests.optional import import_or_skip

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
TABLES = {
    "scans.csv": [{"scan": str(number), "status": "tracked", "reason": "r"} for number in range(9)]
    + [{"scan": "9", "status": "predicted", "reason": "nothing <fits>"}],
    "loops.csv": [
        {"scan": "8", "other_scan": "0", "status": "accepted"},
        {"scan": "7", "other_scan": "99", "status": "accepted"},
    ],
}


def made(folder: Path, num_points: int) -> str:
    numbers = {"status": "done", "verdict": "10 scans & 1 loop", "ate_m": 0.123456789, "versions": {"jax": "0.10"}}
    (folder / "metrics.json").write_text(json.dumps(numbers))
    np.save(folder / "trajectory.npy", np.tile(np.eye(4), (10, 1, 1)))
    rng = np.random.default_rng(0)
    io.write_ply(folder / "map.ply", rng.normal(0, 30, (num_points, 3)).astype(np.float32))
    (folder / "loss.png").write_bytes(b"picture")
    return write_report(folder, lambda name: TABLES.get(name, [])).read_text()


def test_the_page_says_verdict_numbers_and_decisions(tmp_path) -> None:
    text = re.sub(r"<script.*?</script>", "", made(tmp_path, 100), flags=re.DOTALL)
    assert text.index("10 scans &amp; 1 loop") < text.index("loops.csv") < text.index("0.123457")
    assert "<td>versions.jax</td><td>0.10</td>" in text
    assert "nothing &lt;fits&gt;" in text
    assert "tracked" not in text  # nothing to look at
    assert 'src="data:image/png;base64,cGljdHVyZQ=="' in text


def test_the_page_needs_no_network_and_is_small(tmp_path) -> None:
    import_or_skip("plotly")
    text = made(tmp_path, 300_000)
    assert not re.search(r"<script[^>]* src=|<link", text)
    assert len(text) < 10e6


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_the_view_opens_in_a_browser(tmp_path) -> None:
    import_or_skip("plotly")
    made(tmp_path, 1000)
    options = ["--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    options += ["--virtual-time-budget=5000", "--enable-logging=stderr", "--dump-dom"]
    page = (tmp_path / "report.html").as_uri()
    done = subprocess.run([str(CHROMIUM), *options, page], capture_output=True, text=True, timeout=280)
    assert re.search(r"<canvas", done.stdout)
    assert not re.findall(r"CONSOLE.*(?:Error|error)", done.stderr)
