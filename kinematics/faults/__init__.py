"""What is wrong with which channel, point, laser or body: detection, identification, adaptation.

How a diagnosis flows, from a measurement to the verdicts:

    screening           rows that hold nothing: zeros, or no finite values
    unit_slips          units that do not fit the header
    diagnose            one body in one run (records: whose points were recorded one after the other): round
                        after round, the culprit left out each time, until nothing is found
      packing           its lines in few columns, under the present assumptions about the channels
      equal_noise       the noise of its channels where it is not stated (noise; point_noise: within points)
      search            one round: all tests, fits of the suspects, and the best of them
        catalogue       the kinds of fault, one entry each (sentences: what is reported of them)
        state           the rigid fit, score and information of any change of its rows
        nuisance        errors of positions with a stated size, next to the motion
        score_tests     every kind at every place at once
        refit           the fit of one fault, weighed by its evidence
        flexible        patterns that many points share: the body bends
      scatter           errors of one common size at all places
      findings          what was found, and the data without it
    causes/             what many channels share, tried before a body is called flexible (explain): outliers,
                        mains, scattered gains, drift between points, a conjugated laser
    across/             all bodies and runs together (all_bodies): rows under another label (labels),
                        exchanged lines (lines), one ligament between two bodies (ligament, phase)
    verdicts, describe  what is reported of each channel
    detectable          how large a fault must be to be found (detectable_joint: of several points together)
"""
