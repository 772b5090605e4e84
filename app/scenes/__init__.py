"""3D scenes, served by a separate viser process."""
