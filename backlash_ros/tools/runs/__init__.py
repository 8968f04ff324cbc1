"""Runs: read from bags and folders of results, judged, written."""
