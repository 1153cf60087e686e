"""Many runs side by side: statistics, tables, curves and the report."""
