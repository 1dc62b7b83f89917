"""Contact forces: the least forces that hold a moving payload, and the limits of contact patches.

model, registry: contact models by name. load: forces at one sample. paper, soft_finger, grasp,
holding_hands: forces of each kind of pad or hand. worst_cases: forces under uncertainty.
central_path: the interior-point method of grasps.
"""
