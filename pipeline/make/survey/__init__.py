"""From a survey of a line to a site.

In: files that hold lines (GPX, KML, GeoJSON, GeoPackage, Shapefile, tables) or a run with better positions than
GNSS alone.
Out: track, links and balises as in CONTRACT section 2, and findings on what is doubtful.
Touches files: `sources` reads them, `make` alone writes them.

`sources` reads any of them (`xml_lines`, `geojson_lines`, `map_files`, `tables`) to pieces of line (`pieces`); `trace`
cleans what a train recorded; `network` cuts pieces at shared nodes and links their ends; `balises` puts balises on
them; `doubts` says what is remarkable; `make` is the story.
"""
