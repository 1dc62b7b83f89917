"""The rack's job in every form, made once per test process."""

from __future__ import annotations

from functools import cache

from hybrid_opt.bundles import FORMATS, BundleOptions
from hybrid_opt.bundles.manifest import Contents
from hybrid_opt.job.records import SampledJob, sample_job
from tests.hybrid_opt.job.jobs import rack_job

STEPS = {"rapid": 0.1, "urscript": 0.008}


@cache
def sampled(step: float = 0.05) -> SampledJob:
    return sample_job(rack_job(), step)


@cache
def contents(form: str, per_arm: bool = False) -> Contents:
    """The files of a bundle by path, of 0.05 s steps where the form allows that."""
    options = BundleOptions(per_arm=per_arm, any_arm=True)
    return FORMATS[form].files(sampled(STEPS.get(form, 0.05)), options)


def text_of(form: str, name: str, per_arm: bool = False) -> str:
    found = contents(form, per_arm)[name]
    assert isinstance(found, str)
    return found
