"""The report that an engineer sends on: one module a section, and the page and the PDF that join them."""
