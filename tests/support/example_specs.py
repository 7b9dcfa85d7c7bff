"""Specs as the documentation has them, and the smallest that there is."""

EXAMPLE = """\
task: needle
demonstrations: {count: 100, seed: 0}
observations: [gripper_pose, needle_ellipse]
control: {std: 0.1}
hierarchy:
  levels:
    - name: option
      count: 5
      policy: {network: mlp, hidden: [64], dropout: 0.0}
      termination: {network: linear}
  meta_policy: {network: mlp, hidden: [64], emits: [options]}
training:
  initialize: vq
  layerwise: true
  optimizer: {name: adam, lr: 1.0e-3}
  epochs: 200
  batch_size: 16
  restarts: 1
inference: {engine: fused}
selection: {folds: 10, grid: {hierarchy.levels.0.count: [1, 2, 3, 4, 5, 6, 7, 8]}}
rollout: {episodes: 50}
seed: 0
"""

SMALL = {"task": "needle", "observations": ["pose"], "hierarchy": {"levels": [{"count": 5}]}}
