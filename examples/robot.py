"""Run an exported policy where nothing but onnxruntime and NumPy is installed.

`python robot.py policy.onnx` runs the file; docs/export.md says how to make one. Put your
robot into `sense` and `move`: sensors in the order of the env's observation, actions in its units.
"""

import sys

import numpy as np
import onnxruntime


def sense(size):
    """The robot's sensors; here one that stands still."""
    return np.zeros(size, np.float32)


def move(action):
    """The robot's motors; here they only tell."""
    print(" ".join(f"{torque:+.3f}" for torque in action))


session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
about = session.get_modelmeta().custom_metadata_map
size = session.get_inputs()[0].shape[1]
print(f"{about.get('algorithm')} on {about.get('env')}: {size} sensors", file=sys.stderr)
for _ in range(3):  # for ever on a robot, at the env's own pace
    observation = sense(size)[None]  # a batch of one
    move(session.run(None, {"observation": observation})[0][0])
