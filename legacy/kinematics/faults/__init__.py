"""What is wrong with which channel, point, laser or body: detection, identification, adaptation.

The mathematics: the readings y of a line are B z + noise, with the rows B of the beams and the motion z. A
fault changes rows or factors by a few parameters t; errors of positions and lasers with a stated sd are
parameters x with a normal prior. With the tangents T of both and the projector P on the residuals e, the
score is Re T^H e and the information Re T^H P T. All else follows: 2 score^T information^-1 score is chi-
squared without a fault (score_tests), noncentral with one (detectable), Gauss and Newton's step leads to
its size (refit), and the fall of the objective over the width of the prior is its evidence. Noise that is
not stated is a variance estimated from the same residuals, by channel and part of the lines.

How a diagnosis flows, from a measurement to the verdicts:

    screening             rows that hold nothing: zeros, or no finite values
    diagnose              one body in one run, also where points were recorded one after the other: round
                          after round, the culprit left out each time, until nothing is found
      packed_readings     its lines in few columns, under the present assumptions about the channels
      estimated_weights   the noise of its channels where it is not stated (noise_size), and what channels of
                          one point have in common (point_noise)
      search              one round: all tests, fits of the suspects, and the best of them
        catalogue         the kinds of fault with a size, one entry each (sentences: what is said of them)
        score_information a fit of the motion (State), score and information of any change of its rows
        nuisance          the same next to errors of positions and lasers with a prior (Marginal)
        score_tests       every kind at every place at once
        refit             the fit of one fault, weighed by its evidence
        flexible_body     patterns that many points share
        findings          what was found: from the fit to its words and what undoes it
    alternatives          how readings can have been labelled, scaled or ordered otherwise, one entry each
      proposals/          the functions that yield them: unit_slips, exchanges of names and coordinates,
                          causes that many channels share (whole_parts, outliers, gains), places of rows
                          (row_places), orders of lines (line_orders), labels of bodies (body_labels)
      judges/             what decides: what is left to be found (explain), the motion that others show
                          (row_labels), the course of a motion (line_order), one ligament between two
                          bodies (phase_convention)
    verdicts              what is reported of each channel
    adaptation            what is corrected or left out on request
    detectable            how large a fault must be to be found
"""
