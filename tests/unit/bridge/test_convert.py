"""Converting networks: bundles on disk, what is refused, and that nothing half done is left behind."""

from __future__ import annotations

import gzip
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from phase_sumo.bridge.maps.convert import convert
from phase_sumo.cli import main
from phase_sumo.config import POOLS
from phase_sumo.errors import PhaseError
from phase_sumo.report.map_picture import draw_map
from phase_sumo.sim.bundle import MapBundle, load_bundle, save_bundle
from phase_sumo.sim.road_map import RoadKind
from tests.helpers.small_nets import SmallNet, lanes_from


def small_net() -> SmallNet:
    net = SmallNet().edge("a", lanes_from(0, 150, 0, 3.6)).edge("b", lanes_from(150, 300, 3.6))
    return net.connect("a", "b", (1, 0))


def assert_same(one: MapBundle, other: MapBundle) -> None:
    assert one.name == other.name
    assert len(one.pools) == len(other.pools)
    for a, b in (
        (one.road_map, other.road_map),
        (one.graph, other.graph),
        *zip(one.pools, other.pools, strict=True),
    ):
        expected, got = a.arrays(), b.arrays()
        assert expected.keys() == got.keys()
        for name, array in expected.items():
            assert array.dtype == got[name].dtype, name
            np.testing.assert_array_equal(array, got[name], err_msg=name)


@pytest.fixture(scope="module")
def converted(tmp_path_factory) -> tuple[Path, list[dict], list[tuple[float, str]]]:
    folder = tmp_path_factory.mktemp("converted")
    source = small_net().write(folder / "small.net.xml")
    calls: list[tuple[float, str]] = []
    rows = convert(
        [source],
        folder / "out",
        progress=lambda share, name: calls.append((share, name)),
        draw=draw_map,
    )
    return folder / "out", rows, calls


def test_a_bundle_and_a_picture_per_network(converted):
    folder, _, calls = converted
    assert sorted(p.name for p in folder.iterdir()) == ["small.npz", "small.png"]
    assert (folder / "small.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert calls[0] == (0.0, "small.net.xml")


def test_the_summary_counts_what_is_in_the_bundle(converted):
    folder, (row,), _ = converted
    bundle = load_bundle(folder / "small.npz")
    assert (row["name"], row["lanes"], row["warnings"]) == ("small", 3, [])
    assert row["lane_km"] == pytest.approx(0.45)
    assert row["nodes"] == len(bundle.graph.node_lane)
    assert row["links"] == sum(
        int((t >= 0).sum()) for t in (bundle.graph.successor, bundle.graph.left, bundle.graph.right)
    )
    assert row["pairs"] == sum(len(pool.goal) for pool in bundle.pools) > 0
    assert row["lane_change_pairs"] == sum(int((pool.lane_changes != 0).sum()) for pool in bundle.pools) > 0
    assert row["seconds"] >= 0


def test_a_bundle_has_one_pool_per_regime_and_finite_numbers(converted):
    bundle = load_bundle(converted[0] / "small.npz")
    assert len(bundle.pools) == len(POOLS)
    for part in (bundle.road_map, bundle.graph, *bundle.pools):
        for name, array in part.arrays().items():
            assert np.isfinite(array).all(), name
    kinds = set(bundle.road_map.segments()[1].tolist())
    assert kinds == {RoadKind.LANE_BOUNDARY, RoadKind.ROAD_EDGE}


def test_a_bundle_survives_the_disk(tmp_path, straight_map):
    path = tmp_path / "new" / "straight.npz"
    save_bundle(path, straight_map)
    assert_same(straight_map, load_bundle(path))
    assert [p.name for p in path.parent.iterdir()] == ["straight.npz"]


def test_converting_twice_gives_the_same_bundle(converted, tmp_path):
    folder, _, _ = converted
    convert([small_net().write(tmp_path / "small.net.xml")], tmp_path / "again")
    assert not (tmp_path / "again" / "small.png").exists()  # none was asked for
    assert_same(load_bundle(folder / "small.npz"), load_bundle(tmp_path / "again" / "small.npz"))


def test_a_failed_write_leaves_the_old_bundle(tmp_path, straight_map, monkeypatch):
    path = tmp_path / "map.npz"
    save_bundle(path, straight_map)
    before = path.read_bytes()

    def full_disk(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full_disk)
    with pytest.raises(OSError, match="No space"):
        save_bundle(path, replace(straight_map, name="other"))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


# --- bundles that are refused --------------------------------------------------------------------------


def rewritten(path: Path, **changes) -> None:
    with np.load(path) as data:
        arrays = {key: data[key] for key in data.files}
    arrays |= {key.replace("__", "."): value for key, value in changes.items()}
    np.savez_compressed(path, **{key: value for key, value in arrays.items() if value is not None})


def flip(path: Path) -> None:
    """A run of wrong bytes in the middle."""
    data = bytearray(path.read_bytes())
    at = len(data) // 2
    data[at : at + 64] = bytes(255 - b for b in data[at : at + 64])
    path.write_bytes(data)


def garble(path: Path) -> None:
    """An impossible block type at the start of the largest table's deflate stream."""
    with zipfile.ZipFile(path) as archive:
        entry = max(archive.infolist(), key=lambda info: info.compress_size)
    data = bytearray(path.read_bytes())
    name, extra = (int.from_bytes(data[entry.header_offset + k :][:2], "little") for k in (26, 28))
    data[entry.header_offset + 30 + name + extra] = 0x07
    path.write_bytes(data)


@pytest.fixture
def bundle_file(tmp_path, straight_map) -> Path:
    save_bundle(tmp_path / "map.npz", straight_map)
    return tmp_path / "map.npz"


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.unlink(),
        lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
        lambda path: path.write_bytes(b""),
        flip,
        garble,
        lambda path: path.write_text("<net/>"),
        lambda path: np.save(path.open("wb"), np.zeros(3)),
        lambda path: rewritten(path, format=np.array("phase_sumo map bundle 0")),
        lambda path: rewritten(path, format=None),
        lambda path: rewritten(path, layout=np.array((2.0, 16, 16))),
        lambda path: rewritten(path, graph__left=None),
        lambda path: rewritten(path, graph__surplus=np.zeros(1)),
        lambda path: rewritten(path, road__grid=None),
        lambda path: rewritten(path, pools=np.array(7)),
    ],
    ids=[
        "missing", "truncated", "empty", "flipped bytes", "garbled", "xml", "other numpy file", "old",
        "unmarked", "other grid", "no table", "unknown table", "no grid", "too few pools",
    ],
)  # fmt: skip
def test_a_bundle_that_does_not_fit_is_refused(bundle_file, damage):
    damage(bundle_file)
    with pytest.raises(PhaseError) as caught:
        load_bundle(bundle_file)
    message = str(caught.value)
    assert message.startswith(f"{bundle_file}: ")
    assert "phase-sumo convert" in message
    assert "\n" not in message


# --- networks that are refused -------------------------------------------------------------------------


def truncated_gzip() -> bytes:
    return gzip.compress(small_net().text.encode() * 20)[:-40]


BAD_NETWORKS = {
    "missing": (None, "no such network file"),
    "text": (b"lanes and roads", "not well-formed XML"),
    "gzip": (truncated_gzip(), "gzip"),
    "other xml": (b"<routes/>", "<routes>"),
    "no lane": (
        SmallNet().edge("a", lanes_from(0, 99, 0), {0: {"allow": "tram"}}).text.encode(),
        "no lane allows",
    ),
    "no freeway": (SmallNet().edge("a", lanes_from(0, 99, 0), speed=8.3).text.encode(), "no freeway"),
}


@pytest.mark.parametrize("name", BAD_NETWORKS)
def test_a_network_that_cannot_be_used_leaves_nothing_behind(tmp_path, name, capsys):
    content, words = BAD_NETWORKS[name]
    path = tmp_path / "bad.net.xml.gz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(PhaseError) as caught:
        convert([path], tmp_path / "out")
    message = str(caught.value)
    assert str(path) in message
    assert words in message
    assert "\n" not in message
    assert not list((tmp_path / "out").glob("*")), "no output"

    assert main(["convert", str(path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.strip().splitlines()[-1] == f"phase-sumo: {message}"


def test_a_directory_is_no_network(tmp_path):
    with pytest.raises(PhaseError, match="no such network file"):
        convert([tmp_path], tmp_path / "out")


def test_two_networks_of_one_name_are_refused_before_any_work(tmp_path):
    for folder in ("x", "y"):
        (tmp_path / folder).mkdir()
        small_net().write(tmp_path / folder / "small.net.xml")
    with pytest.raises(PhaseError, match=r"both be written to small\.npz"):
        convert([tmp_path / "x" / "small.net.xml", tmp_path / "y" / "small.net.xml"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_versions_in_a_file_name_are_kept_apart(tmp_path):
    paths = [small_net().write(tmp_path / f"road.{k}.net.xml") for k in (1, 2)]
    assert [row["name"] for row in convert(paths, tmp_path / "out")] == ["road.1", "road.2"]


def test_a_map_runs_without_sumo_loaded(converted):
    """Training needs the bundle and nothing of SUMO: queries work from the file alone."""
    bundle = load_bundle(converted[0] / "small.npz")
    xy = torch.from_numpy(bundle.graph.node_xy)[None]
    cells = bundle.road_map.cell(torch.zeros(1, dtype=torch.long), *xy.unbind(-1))
    assert not bundle.road_map.cell_off_road[cells].any()
