"""One description of a picture, drawn as SVG text, as a figure of matplotlib, or as characters.

A picture is a `chart.Chart`: panels of curves, one above the other. `svg`, `figure` and `terminal` draw the same chart
for a report, for a file or a notebook, and for a terminal.
"""
