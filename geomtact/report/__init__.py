"""What a person and a script get to see of a posterior: a table, result.json, report.png and report.html."""
