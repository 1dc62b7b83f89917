"""What pads do: the forces that hold a moving payload, and what patches can carry.

load: forces of one sample. paper, grasp: how they are found. worst_cases: how much is
needed where something is uncertain. central_path: the interior-point method behind them.
"""
