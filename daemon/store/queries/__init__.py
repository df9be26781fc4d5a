"""Statements of each subject: one module for alarms, guides, jobs, models, sessions and so on."""
