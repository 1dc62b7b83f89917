"""Whole jobs as bundles: CSV, JSON, ROS 2, RAPID, URScript, MCAP. docs/export.md describes them."""

from hybrid_opt.bundles.bundle import FORMATS, export
from hybrid_opt.bundles.manifest import BundleOptions, Origin

__all__ = ["FORMATS", "BundleOptions", "Origin", "export"]
