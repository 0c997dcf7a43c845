"""Roads: files, centre lines, cross-sections and markings."""
