"""Recorded runs over HTTP: ended ones, cut-off ones, damaged ones, and those in progress."""

import base64
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from http_client import Client
from recorded_folder import parsed, strike_rows, write_cut_off, write_run

from canwall.panel.frames import SIGNALS
from canwall.record import RunFolder
from canwall.record.folder import lock_folder, stream_of
from canwall.run import read_run

pytestmark = pytest.mark.slow


def items(root: Path) -> dict[str, dict[str, Any]]:
    found: list[dict[str, Any]] = Client(root).get("/api/recorded").json()["items"]
    return {item["name"]: item for item in found}


def url(root: Path, name: str, *, signals: str | None = None) -> str:
    tail = "" if signals is None else f"/signals?{signals}"
    return f"/api/recorded/{items(root)[name]['id']}{tail}"


def refusal(root: Path, path: str) -> tuple[int, str]:
    answer = Client(root).get(path)
    assert set(answer.json()) == {"error"}
    assert "\n" not in answer.json()["error"]
    return answer.status_code, answer.json()["error"]


@pytest.fixture(scope="module")
def rendered() -> Any:
    return strike_rows()


@pytest.fixture
def run(tmp_path: Path, rendered: Any) -> RunFolder:
    return write_run(tmp_path / "a" / "run", *rendered)


def test_a_run_and_its_signals(tmp_path: Path, run: RunFolder, rendered: Any) -> None:
    _, rows, _ = rendered
    item = items(tmp_path)["a/run"]
    summary = run.read_summary()
    assert item["state"] == "complete"
    assert (item["strikes"], item["chatter"]) == (len(summary["strikes"]), summary["chatter"])
    assert item["laws"] == [summary["strikes"][0]["law"]]
    described = Client(tmp_path).get(url(tmp_path, "a/run")).json()
    (strike,) = described["strikes"]
    assert strike["depth_rad"] == summary["strikes"][0]["peak_penetration_rad"]
    assert described["settings"]["wall"]["law"] == item["laws"][0]
    assert described["marks"] == described["remarks"] == []

    times, low, high = parsed(
        Client(tmp_path).get(url(tmp_path, "a/run", signals="points=2000")).content
    )
    np.testing.assert_array_equal(times, rows["t_s"])
    for name, least, largest in zip(SIGNALS, low, high, strict=True):
        np.testing.assert_array_equal(least, rows[name].astype(np.float32))
        np.testing.assert_array_equal(largest, least)
    part = Client(tmp_path).get(url(tmp_path, "a/run", signals="from=0.2&to=0.4&points=10"))
    times, low, high = parsed(part.content)
    inside = (rows["t_s"] >= 0.2) & (rows["t_s"] <= 0.4)
    assert len(times) <= 11
    assert low[0].min() <= rows["y"][inside].min().astype(np.float32)
    assert high[1].max() >= rows["force"][inside].max().astype(np.float32)


def test_a_run_alone_and_marks(run: RunFolder) -> None:
    run.events.write_text('{"cycle": 3, "t_s": 0.003, "what": "mark", "text": "here"}\n{"cyc')
    described = Client(run.path).get(url(run.path, "run")).json()
    assert described["marks"] == [{"cycle": 3, "t_s": 0.003, "what": "mark", "text": "here"}]


def test_a_run_that_was_cut_off_is_read_and_left_alone(tmp_path: Path, rendered: Any) -> None:
    settings, rows, _ = rendered
    folder = write_cut_off(tmp_path / "cut", settings, rows)
    stream = stream_of(folder.signals)
    stream.write_bytes(stream.read_bytes()[:-9000])
    before = sorted(folder.path.iterdir())
    assert items(tmp_path)["cut"]["state"] == "cut off"
    described = Client(tmp_path).get(url(tmp_path, "cut")).json()
    assert "did not end by itself" in described["remarks"][0]
    times, _, high = parsed(
        Client(tmp_path).get(url(tmp_path, "cut", signals="points=2000")).content
    )
    assert 0 < len(times) < len(rows)
    np.testing.assert_array_equal(high[0], rows["y"][: len(times)].astype(np.float32))
    assert sorted(folder.path.iterdir()) == before
    whole = read_run(folder).summary
    assert [s["end_s"] for s in described["strikes"]] == [s["end_s"] for s in whole["strikes"]]


def test_a_damaged_record_is_one_line(tmp_path: Path, run: RunFolder) -> None:
    whole = run.signals.read_bytes()
    run.signals.write_bytes(whole[: len(whole) // 2])
    status, text = refusal(tmp_path, url(tmp_path, "a/run", signals=""))
    assert (status, "not a record of a run" in text) == (422, True)
    middle = len(whole) // 3
    run.signals.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    assert refusal(tmp_path, url(tmp_path, "a/run", signals=""))[0] == 422
    run.summary.write_text("{")
    assert items(tmp_path)["a/run"]["state"] == "damaged"
    assert refusal(tmp_path, url(tmp_path, "a/run"))[0] == 422
    run.config.write_text("[wall")
    run.summary.write_text('{"strikes": []}')
    assert "not valid TOML" in Client(tmp_path).get(url(tmp_path, "a/run")).json()["remarks"][0]


def test_a_run_in_progress_keeps_its_secrets(tmp_path: Path, run: RunFolder) -> None:
    described, signals = url(tmp_path, "a/run"), url(tmp_path, "a/run", signals="")
    lock = lock_folder(run.path)
    assert lock is not None
    try:
        assert items(tmp_path)["a/run"]["state"] == "in progress"
        assert refusal(tmp_path, described)[0] == refusal(tmp_path, signals)[0] == 409
    finally:
        os.close(lock)
    assert Client(tmp_path).get(described).status_code == 200


def test_words_that_lead_elsewhere(tmp_path: Path, run: RunFolder) -> None:
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "link").symlink_to(run.path)
    assert list(items(tmp_path / "b")) == []  # links are not followed
    for path in (b"link", b"../a/run", os.fsencode(run.path), b"no", b"\0", b"a" * 5000):
        word = base64.urlsafe_b64encode(path).decode().rstrip("=")
        assert refusal(tmp_path / "b", f"/api/recorded/{word}")[0] == 404
    for path in (b"a/../a/run", os.fsencode(run.path)):
        word = base64.urlsafe_b64encode(path).decode().rstrip("=")
        assert refusal(tmp_path, f"/api/recorded/{word}")[0] == 404
    assert refusal(tmp_path, "/api/recorded/%C3%A9")[0] == 404
    for query in ("from=a", "points=nan"):
        assert refusal(tmp_path, url(tmp_path, "a/run", signals=query))[0] == 400
    for query in ("from=2&to=1", "points=0", "points=1e9"):
        assert refusal(tmp_path, url(tmp_path, "a/run", signals=query))[0] == 422
