"""``report.html``: a run as one page that opens from disk and asks nothing of any network."""

from hingesplat.report.page import write_report

__all__ = ["write_report"]
