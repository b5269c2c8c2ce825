"""What works around Taichi 1.7.4: all that replaces its parts or stands on names that it does not publish.

A Taichi without one of the names in ``front_end`` is left as it is there; the other files fail loudly. Try a
new version of Taichi with ``tests/compile/test_front_end.py``, ``test_launch.py``, ``test_native.py`` and
``test_capture.py`` first. No committed results file measures the gain of a part alone, so no figure stands
here.

``front_end`` (replaced in ``taichi.lang`` when ``uuvtai.kernels`` is imported)
    ``ASTTransformerContext.get_pos_info``: words a position, source and all, for every node of every inlined
    func; here only where an error is being raised. Can go when Taichi words positions when it raises.
    ``kernel_impl.getsourcefile``, ``getsourcelines``, ``textwrap``, ``ast.parse``: ask for the same source at
    every call of a func; here once. Can go when Taichi keeps what it has read of a func.
    ``kernel_impl._inside_class``: searches all loaded modules for the source of a frame, for every decorator;
    here the frame is asked, from Taichi's import on (``first_import``). Can go when a decorator learns its
    class in another way.
    ``impl.get_traceback``, ``snode.get_traceback``: a whole stack trace for every field; here one line. Can
    go when a field keeps no more than that.
    ``Kernel.materialize``: counts the kernels made, so that a stopwatch leaves their time out, and keeps
    debuggers and coverage out of Taichi's own code. Can go when Taichi tells how many kernels it has made.

``memory``
    ``Memory`` finds every array in Taichi's one block of memory, by the offsets that SNodes hold, because
    ``to_numpy`` and ``from_numpy`` compile two kernels for each field; a log reads its rows there. Can go
    when fields show their memory.

``cache``
    ``stale_locks``: a process that is killed leaves its lock, and from then on nobody uses the cache. Can go
    when Taichi's lock dies with its process. ``CACHE_BYTES`` lifts a limit by an option of ``ti.init``.

``uuvtai.compile.launch`` (a room of its own: ``docs/performance.md``)
    ``quick_launch`` goes round ``Kernel.__call__``, which looks at every argument and hashes every section at
    every launch: the same objects again go straight to the compiled kernel. Stands on ``compiled_kernels``,
    ``ensure_compiled``, ``compile_kernel`` and ``launch_kernel``. Can go when launching with arguments seen
    before costs a lookup.

``uuvtai.compile.launch`` and ``uuvtai.compile.cache``
    ``as_arguments`` takes the place of ``transform_tree``, ``make_constant_expr`` and ``_infer_entry_dt``
    while a kernel is read: numbers of the config become arguments. Can go when Taichi has arguments that
    Python may reckon with beforehand.

Elsewhere, by what Taichi publishes: ``kernels.core.signature.spread`` (its scheduler keeps short loops on one
core), ``config.section.Section.__getattr__`` (what it asks of every argument), ``state.arrays`` (layouts by
nested ``dense``).
"""
