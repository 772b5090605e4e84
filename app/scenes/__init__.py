"""3D scenes, served by a viser process of their own."""
