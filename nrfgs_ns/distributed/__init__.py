# SPDX-License-Identifier: Apache-2.0
"""One scene on several devices: each holds a shard of the splats, and each renders a camera of its own.

With W devices, a step is the step of one process on the mean of the losses of W cameras:

1. Every device knows the cameras of all (`NrfgsDatamanager.next_train_views`: the same order everywhere).
2. It projects its own splats into all of them, and asks the head about each (camera, visible splat) pair (`model.py`).
3. What was projected travels to the device whose camera it was for (`exchange.py`), which blends it into an image and
   compares that with the photograph. Gradients travel back the same way, and with them what densification needs.
4. Each device goes backward through its loss divided by W. Gradients of a splat then arrive where it lives, complete;
   gradients of what all devices have (the head's shared weights, camera poses) are partial, and summed
   (`trainer.py`).

Densification, pruning, resets and Adam are those of one device, on the shard alone. Checkpoints, too, are those of one
device: tables of splats are put together for them, and cut up where they are loaded. Messages (`comm.py`) go by NCCL on
GPUs and gloo on CPUs.
"""
