"""Self-contained HTML pages: scale -> svg -> page -> one module per kind of report."""
