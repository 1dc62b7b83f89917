"""Every mistake ends in an error of `ho.DualArmError` that says what to do.

A carry that cannot be driven is no mistake but a value.
"""

import numpy as np

import hybrid_opt as ho

for kind in (ho.WorkcellError, ho.SettingsError, ho.ResultsError, ho.JobError, ho.ProposalError):
    print(f"{kind.__name__}: {(kind.__doc__ or '').splitlines()[0]}")

cell = ho.example("rack")
try:
    ho.search(cell, "simplex", rng=np.random.default_rng(1))
except ho.DualArmError as error:
    print(f"\n{type(error).__name__} ({error.code}): {error}")
