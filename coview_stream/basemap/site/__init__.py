"""Sites: maps as directories of immutable tiles under a manifest, built from clouds that do not fit into memory.

``manifest``, ``layers`` and ``store`` define the format; ``site_build``, ``tile_build`` and ``executors`` build a site;
``assemble`` and ``working_file`` turn its tiles into a *working file*, a cached map that is memory-mapped; ``fetch``
mirrors it; ``convert`` turns it into one file and back.
"""
