"""``report.html``: a run as one page that opens from disk and asks nothing of any network."""

from hingesplat.report.page import write_report
from hingesplat.report.views import spread_views, write_views

__all__ = ["spread_views", "write_report", "write_views"]
