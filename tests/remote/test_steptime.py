"""The measurement of table 8.3, in small: it measures what it says, and says when it cannot."""

from __future__ import annotations

from pathlib import Path

import pytest

from tutelage.errors import ConfigError
from tutelage.experiments.table_8_3 import NAMES, Table83Config, table
from tutelage.remote.steptime import ours, ssh

pytest.importorskip("zenoh", reason="needs the extra sgc")


def test_a_step_over_the_network_is_faster_than_published(tmp_path: Path) -> None:
    took = ours.measure(2, 10, 32, 32, tmp_path / "fleet")
    assert len(took) == 10
    assert sorted(took)[5] < 0.31


@pytest.mark.skipif(bool(ssh.why_not()), reason=ssh.why_not() or "-")
def test_a_step_over_ssh_and_sftp(tmp_path: Path) -> None:
    took = ssh.measure(2, 3, 32, 32, tmp_path / "ssh", keep_open=True)
    assert len(took) == 3
    assert (tmp_path / "ssh" / "fetched-1").stat().st_size == 32 * 32 * 3


def test_the_table_has_the_published_numbers_beside_ours() -> None:
    row = {"p50": 0.012, "p99": 0.02}
    rows = {"ours": row, "ssh_sftp_open": {"why_not": "not installed: sshd"}, "ssh_sftp_each": row}
    text = table([{"robots": 4, "image": [64, 64, 3], "rows": rows}])
    assert "| 0.31 | 0.0120 (0.020) |" in text
    assert "| 0.86 |" in text
    assert "not installed: sshd" in text
    assert all(name in text for name in NAMES.values())
    with pytest.raises(ConfigError, match="table-8.3 needs 1 to 64 robots"):
        Table83Config(robots=0)
