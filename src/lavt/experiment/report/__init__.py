"""The report of a run, a sweep or a boundary: pages, tables, sentences and figures."""
