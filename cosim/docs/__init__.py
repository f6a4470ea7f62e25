"""The documentation site: pages of prose, and pages rendered from the code."""
