"""The evaluation loop as LIBERO's users write it, run by LIBERO's own Python: what is right.

``python libero_reference.py CHILD_FOLDER ASSETS SUITE TASK EPISODES SIZE OUT.npz``

Nothing of ComVLA takes part, except that initial states are read without torch.
"""

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np

ACTIONS = np.array(
    [
        [0.4, -0.2, -0.6, 0.0, 0.1, 0.2, -1.0],
        [-0.3, 0.5, -0.9, 0.1, 0.0, -0.2, 1.0],
        [0.0, 0.9, 0.2, 0.0, -0.1, 0.0, 1.0],
    ]
)


def main(child, assets, suite, task, episodes, size, out):
    import libero.libero as package

    package._assets_path_cache = assets
    from libero.libero.envs import OffScreenRenderEnv

    spec = importlib.util.spec_from_file_location("states", os.path.join(child, "init_states.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    folder = Path(package.__file__).parent
    states = module.read_init_states(folder / "init_files" / suite / f"{task}.pruned_init")

    env = OffScreenRenderEnv(
        bddl_file_name=str(folder / "bddl_files" / suite / f"{task}.bddl"),
        camera_heights=size,
        camera_widths=size,
    )
    env.seed(0)
    seen = {"frames": [], "proprio": []}

    def note(obs):
        seen["frames"].append(
            np.stack([obs["agentview_image"], obs["robot0_eye_in_hand_image"]])[:, ::-1, ::-1]
        )
        from robosuite.utils.transform_utils import quat2axisangle

        angles = quat2axisangle(obs["robot0_eef_quat"].copy())
        seen["proprio"].append(
            np.concatenate([obs["robot0_eef_pos"], angles, obs["robot0_gripper_qpos"]])
        )

    for episode in range(episodes):
        env.reset()
        obs = env.set_init_state(states[episode])
        for _ in range(10):
            obs, *_ = env.step([0, 0, 0, 0, 0, 0, -1])
        note(obs)
        for action in ACTIONS:
            obs, *_ = env.step(action)
        note(obs)
    env.close()
    np.savez(out, **{name: np.stack(values) for name, values in seen.items()})


if __name__ == "__main__":
    main(*sys.argv[1:5], int(sys.argv[5]), int(sys.argv[6]), sys.argv[7])
