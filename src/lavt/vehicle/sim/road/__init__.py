"""Roads: files, centrelines, cross-sections, and strips on the ground."""
