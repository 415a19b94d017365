"""What people see: pages, exports, the terminal.

In: a result. Out: HTML pages, files of other formats, lines of text.
Touches files of results to read them, and its own outputs.
"""
