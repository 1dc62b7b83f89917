"""Whole jobs as bundles: CSV, JSON, ROS 2, RAPID, URScript, MCAP. docs/export.md describes them."""

from hybrid_opt.store.export.formats import FORMATS, export
from hybrid_opt.store.export.options import BundleOptions
from hybrid_opt.store.export.origin import Origin

__all__ = ["FORMATS", "BundleOptions", "Origin", "export"]
