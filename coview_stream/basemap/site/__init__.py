"""Sites: maps as directories of immutable tiles, named by their hashes, under a manifest; and building them.

``layer_bytes`` and ``cloud_layer`` are the bytes of a tile's layers, ``tile_store`` and ``manifest`` the directory;
``site_build`` makes it out of clouds that do not fit into memory (``partition``, ``tile_build``, ``executors``);
``assemble`` makes the arrays of a map of it, ``split`` a directory of a map.
"""
