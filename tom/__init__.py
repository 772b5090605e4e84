"""TOM Studio's training backend: MBPO with interchangeable model learners.

It knows nothing of the studio (`app`), of Streamlit, Plotly or viser.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("tom-studio")
except PackageNotFoundError:  # running from a source tree that was never installed
    __version__ = "0+unknown"
