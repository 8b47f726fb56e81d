"""What is wrong with which channel, point or body.

How a diagnosis flows, from a measurement to what is told of it:

    screening           rows that hold nothing: zeros, or no finite values
    each_body           one body in one run (records: whose points were recorded one after the other)
      packed/           its lines packed into few (compact), gaps filled by what faulty rows show (fill)
      noise/            the noise of its channels: not stated (unknown_noise), or too large (noisy)
      diagnose          round after round, the culprit left out each time, until nothing is found
        search          one round: all tests, fits of the suspects, and the best of them
          fault_kinds   what faults there are, and which rows each of them makes
          score_tests   every fault at every place at once
          fault_model   the fit of one fault (refit, refit_factor), weighed by its evidence
          structure     patterns that many points share: the body bends
        adequate        do the findings account for the misfit, or are all positions off (scattered)?
        masked          two faults that hide each other
        findings        what was found
    causes/             what many channels share, tried before a body is called flexible (explain): outliers,
                        mains, scattered gains, drift between points, a conjugated laser
    across/             all bodies and runs together (all_bodies): rows under another label (labels),
                        exchanged lines (lines), what one ligament between two bodies tells (ligament, phase)
    neglected           motion outside the fitted degrees of freedom
    verdicts            what is told of each channel
    detectable          how large a fault must be to be found (detectable_joint: of several points together)
"""
