"""The HTML report of an evaluation: one self-contained page, its plots, and the colours of its pictures.

`evaluate` colours its pictures with `colorize_error` and `colorize_causes`, writes `results.json` and the pictures into
a folder, and hands both to `write_report`. The report shows what is there: every entry of the results may be absent.
"""

from jaxtrapolate.report.colors import CAUSE_COLORS as CAUSE_COLORS
from jaxtrapolate.report.colors import ERROR_LIMIT as ERROR_LIMIT
from jaxtrapolate.report.colors import colorize_causes as colorize_causes
from jaxtrapolate.report.colors import colorize_error as colorize_error
from jaxtrapolate.report.page import render_report as render_report
from jaxtrapolate.report.page import write_report as write_report
from jaxtrapolate.report.plots import plot_causes as plot_causes
from jaxtrapolate.report.plots import plot_error_time as plot_error_time
from jaxtrapolate.report.plots import plot_frames as plot_frames
from jaxtrapolate.report.video import VIDEO_FORMATS as VIDEO_FORMATS
from jaxtrapolate.report.video import check_video_format as check_video_format
from jaxtrapolate.report.video import side_by_side as side_by_side
from jaxtrapolate.report.video import write_video as write_video
