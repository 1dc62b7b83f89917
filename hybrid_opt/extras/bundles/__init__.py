"""Whole jobs as bundles that drivers run as they are. docs/reference/bundles.md describes them."""

from hybrid_opt.extras.bundles.bundle import TARGETS, Origin, export
from hybrid_opt.extras.bundles.job_file import BundleOptions

__all__ = ["TARGETS", "BundleOptions", "Origin", "export"]
