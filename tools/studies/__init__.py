"""Posteriors judged on touches with known poses, one study a folder and a command: ``python -m tools.studies STUDY``.

A folder holds the ``command``, what is judged and summarised (``study``) and the picture (``plot``). ``common`` holds what
studies share. The files that they write are in ``docs/results``.

================  =====================================================
study             what is judged
================  =====================================================
``samples``       nothing: what the touches are like
``localize``      one touch: information, calibration, error, time
``scores``        one score after another, on the same touches
``adaptive``      a touch within its cells: opened, or sampled
``choices``       every default: speed, accuracy, an ablation study
``stability``     what breaks a posterior, and whether it warns
``thesis``        the thesis's Table 1, and what a touch leaves open
``touches``       one to five sensors at once
``triplets``      three touches of another simulator
``identify``      object identification
``registration``  refinement alone, beside other libraries
``track``         the filter
``next-touch``    touches until sure
``kitting``       objects placed in a fixture
``readings``      real tactile images
================  =====================================================
"""
