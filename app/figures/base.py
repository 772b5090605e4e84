"""What all figures share: margins, axes, hover. Text colours follow the page's own theme."""

import plotly.graph_objects as go

DASHES = ("solid", "dash", "dot", "dashdot")
"""for lines of one colour"""
GRID = "rgba(128, 138, 158, 0.22)"


def styled(figure: go.Figure, x: str, height: int, *, keep: str) -> go.Figure:
    """`figure` with the house's layout; the reader's zoom survives as long as `keep` stays.

    What the figure shows is said above it, on the page.
    """
    figure.update_layout(
        height=height,
        margin={"l": 4, "r": 26, "t": 14, "b": 4},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        hovermode="closest",
        uirevision=keep,
        legend={"orientation": "h", "yanchor": "bottom", "y": 1.0, "x": 0, "xanchor": "left"},
        font={"size": 12},
    )
    axis = {"gridcolor": GRID, "zeroline": False, "automargin": True}
    figure.update_xaxes(title_text=x, showgrid=False, ticks="outside", tickcolor=GRID, **axis)
    figure.update_yaxes(title_standoff=8, **axis)  # without, wide ticks run into the title
    return figure


def note(figure: go.Figure, text: str) -> go.Figure:
    """A remark in the figure's corner: what a reader must know about what is drawn."""
    figure.add_annotation(
        text=text,
        xref="paper",
        yref="paper",
        x=1,
        y=0,
        xanchor="right",
        yanchor="bottom",
        showarrow=False,
        font={"size": 11},
        opacity=0.75,
    )
    return figure
