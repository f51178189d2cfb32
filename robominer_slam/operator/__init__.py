"""The remote operator's console: what a robot publishes (or a recording holds) in, a web page out.

`link.py`, `recording_source.py` and what they fill (`robot_view.py` and its parts) know nothing of the page; the
page (`server.py`, `page.py`, `static/`) knows nothing of Zenoh.
"""
