"""A child that speaks the protocol of LIBERO's simulator without a simulator, and can misbehave.

``python libero_fake_child.py CHILD_FOLDER BEHAVIOUR SIZE``
"""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

CHILD = Path(sys.argv[1])
BEHAVIOUR = sys.argv[2]
SIZE = int(sys.argv[3])


def load_main() -> Any:
    """The real child's entry, for its way of taking over the pipes and finding its package."""
    spec = importlib.util.spec_from_file_location("child_main", CHILD / "__main__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Fake:
    """The hand moves by half a centimetre per unit of action; above z = 1.2 the goal is met.

    One bowl stands on the table and one plate. Frames hold their own position, so that a flip shows.
    """

    def __init__(self, message: Any) -> None:
        self._message = message
        self._hand = np.zeros(3)
        self._fingers = 0.04
        self._task = self._init_state = -1

    def ready(self) -> Any:
        if BEHAVIOUR == "broken":
            raise RuntimeError("no simulator today")
        tasks = [
            {"name": f"task_{i}", "instruction": f"do task {i}", "init_states": 50}
            for i in range(10)
        ]
        if BEHAVIOUR == "odd-greeting":
            return self._message("ok", {"tasks": [{"name": "x"}], "versions": {}})
        return self._message("ok", {"tasks": tasks, "versions": {"robosuite": "0"}})

    def reset(self, request: Any) -> Any:
        if BEHAVIOUR == "no-assets":
            error: type[Exception] = sys.modules["comvla_libero_child.server"].AssetsMissing
            raise error("scenes/table.xml")
        self._task, self._init_state = request.fields["task"], request.fields["init_state"]
        self._hand = np.array([-0.2, 0.01 * self._init_state, 1.1])
        self._fingers = 0.04
        reading = self.reading()
        points = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)]) * 0.02
        fields = {
            "things": [["bowl", "object"], ["plate", "object"], ["drawer", "region"]],
            "sizes": [[0, 0, 0], [0, 0, 0], [0.1, 0.1, 0.05]],
            "goal": [["open", "drawer"]] if self._task == 9 else [["on", "bowl", "plate"]],
        }
        if BEHAVIOUR == "odd-scene":
            fields["things"] = [["bowl"]]
        base = np.array([-0.66, 0, 0.9])
        return self._message("ok", fields, {**reading.arrays, "points/bowl": points, "base": base})

    def step(self, request: Any) -> Any:
        if BEHAVIOUR == "dies":
            print("I cannot go on", file=sys.stderr, flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        if BEHAVIOUR == "exits":
            os._exit(3)
        if BEHAVIOUR == "hangs":
            print("thinking", flush=True)  # must not get into the pipe
            time.sleep(1000)
        if BEHAVIOUR == "garbage":
            os.write(self.pipe, b"<html>this is no message, not at all</html>")
        if BEHAVIOUR == "fails":
            raise ValueError("the arm fell off")
        action = request.arrays["action"]
        self._hand = self._hand + 0.005 * action[:3]
        self._fingers = float(np.clip(self._fingers - 0.01 * np.sign(action[6]), 0, 0.04))
        return self.reading()

    def reading(self) -> Any:
        poses = np.zeros((3, 7))
        poses[:, 6] = 1
        poses[:, :3] = [[0.05, 0.1, 0.9], [0.05, 0.3, 0.9], [0.3, 0, 1]]
        arrays = {
            "eef_pos": self._hand,
            "eef_quat": np.array([1.0, 0, 0, 0]),
            "gripper_qpos": np.array([self._fingers, -self._fingers]),
            "met": np.array([self._hand[2] > 1.2]),
            "poses": poses,
        }
        if BEHAVIOUR == "odd-reading":
            del arrays["met"]
        return self._message("ok", {}, arrays)

    def draw(self, request: Any) -> Any:
        rows, columns = np.mgrid[:SIZE, :SIZE]
        frames = np.empty((2, SIZE, SIZE, 3), np.uint8)
        frames[..., 0], frames[..., 1], frames[0, ..., 2], frames[1, ..., 2] = rows, columns, 7, 9
        return self._message("ok", {}, {"frames": frames})

    def cameras(self, request: Any) -> Any:
        eye = np.eye(3)[None].repeat(2, 0)
        arrays = {
            "positions": np.array([[0, 0, 3.0], [0, 0, 2.0]]),
            "rotations": eye,
            "fovy_deg": np.array([90.0, 45]),
        }
        return self._message("ok", {}, arrays)

    def get_state(self, request: Any) -> Any:
        return self._message("ok", {}, {"state": np.array([*self._hand, self._fingers])})

    def set_state(self, request: Any) -> Any:
        state = request.arrays["state"]
        self._hand, self._fingers = state[:3].copy(), float(state[3])
        return self.reading()


def main() -> None:
    entry = load_main()
    reader, writer = entry.take_pipes()
    print("chatter on stdout, as LIBERO prints it")
    if BEHAVIOUR == "silent":
        time.sleep(1000)
    entry.load_package()
    framing = importlib.import_module("comvla_libero_child.framing")
    server = importlib.import_module("comvla_libero_child.server")

    def start() -> Fake:
        fake = Fake(framing.Message)
        fake.pipe = writer.fileno()  # type: ignore[attr-defined]
        return fake

    server.serve(reader, writer, start)


main()
