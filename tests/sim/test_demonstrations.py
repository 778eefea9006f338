"""Demonstrations hold what the expert would do under every instruction, and survive interruption."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("metaworld")

from comvla_sim.training.demonstrations import (
    Demonstrations,
    DemonstrationsError,
    Progress,
    generate,
)
from comvla_sim.training.recording import choose_tasks
from comvla_sim.worlds import make
from comvla_sim.worlds.base import Task

pytestmark = [pytest.mark.simulator, pytest.mark.filterwarnings("ignore:Constant")]

# Small pictures, few of them: what is claimed does not depend on either.
SETTINGS: dict[str, Any] = {"image_size": 32, "image_stride": 15, "layouts_per_shard": 2}
LAYOUTS = range(40, 45)
FILES = ("images", "proprio", "chunks", "possible", "points", "uv", "task", "layout", "episode")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demonstrations") / "train"
    generate(out, layouts=LAYOUTS, workers=2, **SETTINGS)
    return out


@pytest.fixture(scope="module")
def data(folder: Path) -> Demonstrations:
    return Demonstrations(folder)


def test_the_arrays_have_the_promised_shapes(data: Demonstrations) -> None:
    frames, tasks = len(data), 8
    expected: dict[str, tuple[tuple[int, ...], type]] = {
        "proprio": ((4,), np.float32),
        "chunks": ((tasks, 8, 4), np.float16),
        "possible": ((tasks,), np.bool_),
        "points": ((tasks, 4, 3), np.float32),
        "uv": ((tasks, 2, 4, 2), np.float32),
        "task": ((), np.int16),
        "layout": ((), np.int32),
        "t": ((), np.int16),
        "episode": ((), np.int32),
    }
    for name, (shape, dtype) in expected.items():
        array = getattr(data, name)
        assert array.shape == (frames, *shape), name
        assert array.dtype == dtype, name
        assert np.isfinite(array).all(), name
    assert frames > 2 * len(LAYOUTS)
    assert data.gather_images([0]).shape == (1, 2, 32, 32, 3)


def test_every_layout_gives_two_episodes_about_different_fixtures(data: Demonstrations) -> None:
    fixture = [name.split("-")[0] for name in data.tasks]
    for layout in LAYOUTS:
        here = data.layout == layout
        assert len(set(data.episode[here])) == 2
        assert len({fixture[task] for task in data.task[here]}) == 2


def test_the_expert_succeeds_in_the_recorded_episodes(data: Demonstrations) -> None:
    succeeded, episodes = np.sum(list(data.successes.values()), axis=0)
    assert episodes == 2 * len(LAYOUTS)
    assert succeeded == episodes


def test_labels_are_what_the_expert_does_under_each_instruction(data: Demonstrations) -> None:
    world = make("tabletop", image_size=32)
    checked = 0
    for frame in np.flatnonzero(data.t == 0)[:4]:
        own = data.tasks[data.task[frame]]
        for index, name in enumerate(data.tasks):
            if not data.possible[frame, index]:
                assert not data.chunks[frame, index].any()
                continue
            world.reset(seed=int(data.layout[frame]), options={"task": own})
            points = world.points_of_interest(name)
            np.testing.assert_allclose(data.points[frame, index], points, atol=1e-6)
            np.testing.assert_allclose(data.uv[frame, index], world.project(points), atol=1e-5)
            chunk = []
            for _ in range(8):
                chunk.append(world.expert_action(name))
                world.advance(chunk[-1])
            np.testing.assert_array_equal(data.chunks[frame, index], np.float16(chunk))
            checked += 1
    assert checked >= 12
    world.close()


def test_the_picture_is_that_of_the_labelled_state(data: Demonstrations) -> None:
    world = make("tabletop", image_size=32)
    frame = int(np.flatnonzero(data.t == 0)[3])
    options = {"task": data.tasks[data.task[frame]]}
    observation, info = world.reset(seed=int(data.layout[frame]), options=options)
    np.testing.assert_array_equal(data.gather_images([frame])[0], observation["images"])
    np.testing.assert_array_equal(data.proprio[frame], observation["proprio"])
    possible = [name for name, p in zip(data.tasks, data.possible[frame], strict=True) if p]
    assert tuple(possible) == info["possible_tasks"]
    world.close()


def test_the_same_picture_has_other_labels_under_another_instruction(data: Demonstrations) -> None:
    for frame in range(len(data)):
        chunks = data.chunks[frame][data.possible[frame]]
        assert len(np.unique(chunks.reshape(len(chunks), -1), axis=0)) > 1


def test_points_lie_inside_the_pictures(data: Demonstrations) -> None:
    uv = data.uv[data.possible]
    assert uv.min() > 0
    assert uv.max() < 1


def test_pictures_are_gathered_in_the_order_asked_for(data: Demonstrations) -> None:
    order = np.random.RandomState(0).permutation(len(data))
    shuffled = data.gather_images(order)
    np.testing.assert_array_equal(shuffled[np.argsort(order)], data.gather_images(range(len(data))))
    for index in (-1, len(data)):
        with pytest.raises(IndexError, match="frames are 0 to"):
            data.gather_images([index])


def test_an_interrupted_generation_goes_on_where_it_stopped(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"

    def interrupt(progress: Progress) -> None:
        if progress.layouts_done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(out, layouts=LAYOUTS, workers=1, progress=interrupt, **SETTINGS)
    first = sorted(path.name for path in out.glob("shard-*"))
    assert first == ["shard-00000"]
    times = {name: (out / name).stat().st_mtime_ns for name in first}
    (out / ".shard-00001.tmp").mkdir()  # as a killed run leaves it

    seen: list[Progress] = []
    generate(out, layouts=LAYOUTS, workers=1, progress=seen.append, **SETTINGS)
    assert seen[0].layouts_done == 2 * len(first)
    assert seen[-1].layouts_done == seen[-1].layouts_total == len(LAYOUTS)
    assert {name: (out / name).stat().st_mtime_ns for name in first} == times
    assert not list(out.glob(".shard*"))
    for shard in sorted(folder.glob("shard-*")):
        for name in FILES:
            file = f"{name}.npy"
            assert (out / shard.name / file).read_bytes() == (shard / file).read_bytes(), file


def test_a_finished_data_set_is_left_alone_and_can_be_continued(folder: Path) -> None:
    seen: list[Progress] = []
    generate(folder, layouts=LAYOUTS, progress=seen.append, **SETTINGS)
    assert seen == [Progress(5, 5, len(Demonstrations(folder)))]
    # The last shard has one layout of two: more layouts would change it.
    with pytest.raises(DemonstrationsError, match="other layouts"):
        generate(folder, layouts=range(40, 47), **SETTINGS)


def test_other_settings_or_layouts_are_not_mixed_in(folder: Path) -> None:
    with pytest.raises(DemonstrationsError, match="other settings"):
        generate(folder, layouts=LAYOUTS, **(SETTINGS | {"noise": 0.3}))
    with pytest.raises(DemonstrationsError, match="other layouts"):
        generate(folder, layouts=range(5), **SETTINGS)


def test_senseless_requests_are_refused(tmp_path: Path) -> None:
    for layouts in ([], [1, 1]):
        with pytest.raises(ValueError, match="different seeds"):
            generate(tmp_path, layouts=layouts)
    with pytest.raises(ValueError, match="workers"):
        generate(tmp_path, layouts=[1], workers=0)
    with pytest.raises(TypeError, match="colour"):
        generate(tmp_path, layouts=[1], colour="green")
    with pytest.raises(ValueError, match="unknown world"):
        generate(tmp_path, layouts=[1], world="kitchen")
    assert not list(tmp_path.iterdir())


def test_reading_says_what_is_wrong(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DemonstrationsError, match="no demonstrations"):
        Demonstrations(tmp_path)
    (tmp_path / "manifest.json").write_bytes((folder / "manifest.json").read_bytes())
    with pytest.raises(DemonstrationsError, match="no finished shard"):
        Demonstrations(tmp_path)
    shard = tmp_path / "shard-00000"
    shard.mkdir()
    for file in (folder / "shard-00000").iterdir():
        (shard / file.name).write_bytes(file.read_bytes())
    assert len(Demonstrations(tmp_path)) > 0
    np.save(shard / "proprio.npy", np.zeros((1, 4), np.float32))
    with pytest.raises(DemonstrationsError, match=r"1 frames, expected .* generate again"):
        Demonstrations(tmp_path)
    (shard / "proprio.npy").write_bytes(b"not an array")
    with pytest.raises(DemonstrationsError, match="cannot read"):
        Demonstrations(tmp_path)
    (shard / "shard.json").write_text("{")
    with pytest.raises(DemonstrationsError, match=r"shard\.json"):
        Demonstrations(tmp_path)


def test_seldom_recorded_tasks_come_first() -> None:
    tasks = [Task(f"{fixture}-{i}", "", (), fixture) for fixture in "abc" for i in range(2)]
    random = np.random.RandomState(0)
    counts: dict[str, int] = {}
    for _ in range(60):
        chosen = choose_tasks(tasks, counts, 2, random)
        assert chosen[0].fixture != chosen[1].fixture
    assert sum(counts.values()) == 120
    assert max(counts.values()) - min(counts.values()) <= 2
    assert len(choose_tasks(tasks[:2], {}, 2, random)) == 2
