"""Answers held against the truth, a study a command (``geomtact evaluate COMMAND``, whose file is in ``docs/results``):

===============  ============================  =====================================================
command          module                        what is judged
===============  ============================  =====================================================
``localize``     ``study``, ``proper``         one touch: information, calibration, error, time
``scores``       ``scores``                    one score after another, on the same touches
``choices``      ``choices``                   every default: speed, accuracy, what each thing adds
``stability``    ``stability``, ``worlds``     what breaks an answer, and whether it knows
``thesis``       ``known_approach``,           the thesis's Table 1, and what a touch leaves open
                 ``ambiguity``, ``alike``
``touches``      ``sensors_study``             what each more sensor adds
``triplets``     ``triplets``                  three touches of another simulator
``identify``     ``identification``            which part it is
``registration`` ``registration``, ``peers``,  refinement alone, beside other libraries
                 ``information``, ``shapes``
``track``        ``track_study``,              the filter
                 ``trajectories``
``next-touch``   ``next_touch_study``          touches until sure
``kitting``      ``kitting_study``,            parts placed in a fixture
                 ``kitting``, ``fixture``
``readings``     ``readings``, ``groove``      real readings
===============  ============================  =====================================================

What they share: ``touches`` makes touches at known poses, ``contact_class`` names their kind, ``answer`` holds an answer against
the truth, ``pose_error`` says how wrong it is.
"""
