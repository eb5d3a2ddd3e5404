"""Several driver models side by side: runs, measures, report."""
