"""Pages for a browser, each one file with all that it needs: a map to look into, and a flow that
plays.

It imports `plotting`, `maps` and the folders below them. Begin with `explore`; `map_data` lists
what a page of a map holds, and `document` puts a page together. The files beside them are what the
browser runs.
"""
