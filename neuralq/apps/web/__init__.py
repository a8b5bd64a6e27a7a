"""The divergence lab in a browser: pick a problem and a method, move γ, λ and α, and see at once what becomes of it.

`serve` runs it on this machine only, `lab_app` is the application itself. The page is written by hand and drawn by
the plotly script that the installed plotly package holds; nothing is fetched from elsewhere. Needs the extra ``web``.
The same server shows the games that `neuralq.apps.web.play` keeps, with `play_app`.
"""

from neuralq.apps.web.server import lab_app, play_app, serve

__all__ = ["lab_app", "play_app", "serve"]
