"""A comparison as tables, figures and pages."""
