"""Whole jobs as bundles that drivers run as they are. docs/export.md describes them."""

from hybrid_opt.bundles.bundle import TARGETS, export
from hybrid_opt.bundles.job_file import BundleOptions
from hybrid_opt.bundles.manifest import Origin

__all__ = ["TARGETS", "BundleOptions", "Origin", "export"]
