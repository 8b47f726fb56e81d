"""A block of a page that steps through the slices of the scan with the labels on them."""

from legacy.ct_inertia.report.slice_browser.browser import slice_browser

__all__ = ["slice_browser"]
