"""Sweeps over HTTP: their maps, and strikes that are simulated again."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from http_client import Client
from recorded_folder import parsed
from rig import settings_with

from canwall.analysis.strike import first_depth
from canwall.sweep import make_plan, sweep

pytestmark = pytest.mark.slow

AXES = {
    "law": ["standard", "half_sample"],
    "delay": [0, 1],
    "stiffness_normalised": "0.01:0.6:4",
    "damping_normalised": "0:0.8:3",
    "operator": "finger",
    "servo": "ideal",
    "speed": [0.5, 1.0],
    "phase": [0.35],
}


def swept(path: Path, **axes: object) -> xr.Dataset:
    return sweep(make_plan(settings_with(), axes), path)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Client, xr.Dataset]:
    folder = tmp_path_factory.mktemp("sweeps")
    return Client(folder), swept(folder / "map.nc", **AXES)


def url(client: Client) -> str:
    (item,) = client.get("/api/recorded").json()["items"]
    return f"/api/sweep/{item['id']}"


def struck(client: Client, **indices: int) -> tuple[dict[str, Any], Any]:
    answer = client.post(f"{url(client)}/strike", json={"indices": indices})
    assert answer.status_code == 200, answer.text
    (length,) = struct.unpack_from("<I", answer.content)
    assert (4 + length) % 8 == 0
    return json.loads(answer.content[4 : 4 + length]), parsed(answer.content[4 + length :])


def test_a_map_at_each_of_its_conditions(made: tuple[Client, xr.Dataset]) -> None:
    client, dataset = made
    for law, delay in ((0, 0), (1, 1)):
        shown = client.get(f"{url(client)}?law={law}&delay={delay}").json()
        at = dataset["chatters"].isel(law=law, delay=delay, operator=0, servo=0)
        worst = at.any(["speed", "phase"])
        np.testing.assert_array_equal(shown["chatters"], worst.values)
        axes = {axis["name"]: axis for axis in shown["axes"]}
        np.testing.assert_array_equal(axes[shown["x"]]["values"], at[shown["x"]])
        np.testing.assert_array_equal(axes[shown["y"]]["values"], at[shown["y"]])
        words = [(axes[name]["label"], axes[name]["unit"]) for name in AXES if name != "servo"]
        assert words[:3] == [("law of the wall", ""), ("delay D", "cycles"), ("K·T²/m", "")]
        assert words[-2] == ("mean speed of the hand's approach", "rad/s")
        # Colgate and Schenkel: K·T/2 + B = b of the device, D = 0.
        passive = [line for line in shown["limits"] if line["kind"] == "passive"]
        (period, mass, device) = (
            dataset[name].isel(law=law, delay=delay, operator=0, servo=0).item()
            for name in ("period", "inertia", "device_viscous")
        )
        for line in passive[: 1 - delay]:
            x, y = (np.array(line[axis]) for axis in "xy")
            stiffness, damping = x * mass / period**2, y * mass / period
            inside = stiffness > 0.0
            np.testing.assert_allclose(
                (stiffness * period / 2 + damping)[inside], device, rtol=1e-9
            )
    assert client.get(f"{url(client)}?law=2").status_code == 422
    assert client.get(f"{url(client)}?phase=0").status_code == 422
    assert client.get(f"{url(client)}?law=x").status_code == 400


def test_a_strike_again_is_the_one_of_the_sweep(made: tuple[Client, xr.Dataset]) -> None:
    client, dataset = made
    chattering = 0
    for i in range(4):
        indices = {"law": i % 2, "delay": i // 2, "stiffness_normalised": i, "speed": 1}
        text, (times, low, high) = struck(client, **indices)
        point = dataset.isel({name: indices.get(name, 0) for name in dataset["chatters"].dims})
        assert text["same"]
        chattering += bool(point["chatters"])
        assert text["found"]["chatters"] == bool(point["chatters"])
        columns = dict(zip(text["columns"], zip(low, high, strict=True), strict=True))
        deepest = -columns["y"][0].min()
        assert deepest == pytest.approx(point["penetration"].item(), rel=1e-6)
        referent = columns["referent_y"][0].astype(float)
        # At rest on the wall the hand feels the wall's force, as the law demands it.
        pressed = slice(len(times) // 2, len(times) // 2 + 50)
        if not point["chatters"]:
            felt, force = (columns[name][0][pressed].mean() for name in ("felt", "force"))
            assert felt == pytest.approx(force, abs=0.02)
        depth = point["referent_first_depth"].item()
        assert first_depth(referent) == pytest.approx(depth, rel=1e-6)
        unit = point["inertia"].item() / point["period"].item() ** 2
        assert text["stiffness"] == point["stiffness_normalised"].item() * unit
        assert np.all(np.diff(times) > 0)
    assert 0 < chattering < 4


def test_a_search_shows_its_limits_and_the_strike_there(tmp_path: Path) -> None:
    axes = {key: value for key, value in AXES.items() if key != "stiffness_normalised"}
    dataset = swept(tmp_path / "limits.nc", **axes | {"delay": [1]})
    client = Client(tmp_path)
    shown = client.get(f"{url(client)}?law=1").json()
    assert (shown["kind"], shown["y"]) == ("limits", None)
    np.testing.assert_array_equal(shown["worst"], dataset["worst"].isel(law=1).values.ravel())
    text, _ = struck(client, law=1, speed=1)
    assert (text["same"], text["found"]["chatters"]) == (True, False)
    assert text["stiffness"] == dataset["worst"].isel(law=1).values.ravel()[0]


def test_what_is_no_sweep_or_no_point(tmp_path: Path, made: tuple[Client, xr.Dataset]) -> None:
    (tmp_path / "a.nc").write_text("no")
    client = Client(tmp_path)
    answer = client.get(url(client))
    assert answer.status_code == 422
    assert "not the result of a sweep" in answer.json()["error"]
    assert client.post(f"{url(client)}/strike", json={"indices": {}}).status_code == 422
    client, dataset = made
    for content in ({"json": []}, {"content": b"{"}, {"json": {"indices": {"law": "a"}}}):
        assert client.post(f"{url(client)}/strike", **content).status_code == 400
    assert client.post(f"{url(client)}/strike", json={"indices": {"law": 9}}).status_code == 422
    assert client.get(f"{url(client)}/strike").status_code == 405
    xr.Dataset(attrs=dict(dataset.attrs)).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    client = Client(tmp_path)
    assert "lacks its axes" in client.get(url(client)).json()["error"]


def test_a_measure_that_differs_is_told(tmp_path: Path, made: tuple[Client, xr.Dataset]) -> None:
    _, dataset = made
    changed = dataset.copy(deep=True)
    changed["penetration"][:] *= 1.001
    changed.to_netcdf(tmp_path / "map.nc", engine="h5netcdf")
    text, _ = struck(Client(tmp_path))
    assert not text["same"]


def test_strike_of_a_law_that_asks_for_any_force(tmp_path: Path) -> None:
    (tmp_path / "big.py").write_text(
        "def big(wall):\n    return 1e300 if wall.y < 0.0 else 0.0\n", encoding="utf-8"
    )
    one = AXES | {"law": f"{tmp_path / 'big.py'}:big", "stiffness_normalised": "0.1:0.2:2"}
    swept(tmp_path / "map.nc", **one)
    struck(Client(tmp_path), delay=0, stiffness_normalised=0, damping_normalised=0, speed=0)
