"""The report of a run, a sweep or a boundary search: page, tables, sentences and figures."""
