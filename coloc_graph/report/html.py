"""`report.html`: one file that says how well a run was solved, with nothing to fetch and nothing to run."""
