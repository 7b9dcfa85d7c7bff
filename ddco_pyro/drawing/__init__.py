"""Building blocks of pages and figures: words, colours, tables, plots."""
