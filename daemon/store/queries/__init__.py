"""SQL statements by subject: one module each for alarms, guides, jobs, models, sessions and so on."""
