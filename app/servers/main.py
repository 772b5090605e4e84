"""Streamlit's entry: it only calls the studio's router."""

from app.router import run

run()
