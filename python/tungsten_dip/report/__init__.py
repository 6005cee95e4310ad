"""What a result looks like and how good it is: metrics, previews and the HTML page."""

from tungsten_dip.report.metrics import Comparison, compare

__all__ = ["Comparison", "compare"]
