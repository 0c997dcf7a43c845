"""Roads: files, centrelines, cross-sections and marks."""
