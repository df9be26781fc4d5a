"""Reports as PDF by WeasyPrint, which is optional because it needs Pango from the system (docs/decisions/0031)."""

from __future__ import annotations

import logging

HOW_TO_INSTALL = "pip install 'rigcal[pdf]' and apt install libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0"


class PdfError(Exception):
    """A PDF cannot be made on this computer."""


def pdf_of(page: str) -> bytes:
    """Convert a self-contained page to PDF: A4, with page numbers; nothing is loaded from elsewhere.

    Args:
        page: the HTML document.

    Raises:
        PdfError: WeasyPrint or a library that it needs is not installed.
    """
    try:
        import weasyprint
        from weasyprint.urls import URLFetcher
    except (ImportError, OSError) as error:  # OSError: the package is installed, but not Pango
        raise PdfError(
            f"a PDF needs WeasyPrint with Pango: {HOW_TO_INSTALL}; or print the HTML page from any browser"
        ) from error

    for name in ("weasyprint", "fontTools"):
        logging.getLogger(name).setLevel(logging.ERROR)  # they warn of every unknown CSS property
    fetcher = URLFetcher(allowed_protocols=["data"])
    document: bytes = weasyprint.HTML(string=page, url_fetcher=fetcher).write_pdf()
    return document
