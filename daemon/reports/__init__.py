"""The record as others read it: tables, files, figures, pages; and the targets to print."""
