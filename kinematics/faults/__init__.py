"""What is wrong with which channel, point, laser or body: detection, identification, adaptation.

The mathematics: the readings y of a line are B z + noise, with the rows B of the beams and the motion z. A
fault changes rows or factors by a few parameters t; errors of positions with a stated sd are parameters x
with a normal prior. With the tangents T of both and the projector P on the residuals e, the score is Re T^H
e and the information Re T^H P T. All else follows: 2 score^T information^-1 score is chi-squared without a
fault (score_tests), noncentral with one (detectable), Gauss and Newton's step leads to its size (refit),
and the fall of the objective over the width of the prior is its evidence. Noise that is not stated is a
variance estimated from the same residuals, by channel and part of the lines.

How a diagnosis flows, from a measurement to the verdicts:

    screening             rows that hold nothing: zeros, or no finite values
    unit_slips            units that do not fit the header
    diagnose              one body in one run (sequential_records: whose points were recorded one after the
                          other): round after round, the culprit left out each time, until nothing is found
      packed_readings     its lines in few columns, under the present assumptions about the channels
      estimated_weights   the noise of its channels where it is not stated (noise_size), and what channels of
                          one point have in common (point_noise)
      search              one round: all tests, fits of the suspects, and the best of them
        catalogue         the kinds of fault, one entry each (sentences: what is reported of them)
        score_information a fit of the motion (State), score and information of any change of its rows
        uncertain_positions  the same next to errors of many places with a prior (Marginal)
        score_tests       every kind at every place at once
        refit             the fit of one fault, weighed by its evidence
        flexible_body     patterns that many points share
        findings          what was found: from the fit to its words and what undoes it
    causes/               what many channels share, tried before a body is called flexible (explain):
                          outliers, mains, scattered gains, ranges and cycles of points, drift between
                          them, a conjugated laser
    mislabelled/          all bodies and runs together (search_all_bodies): rows under another label
                          (row_labels, a table of places), lines in another order (line_order), and whole
                          bodies (body_labels, a table of labels; body_sizes, of factors) by the ligament
                          between two (two_bodies, relative_scale)
    verdicts              what is reported of each channel
    adaptation            what is corrected or left out on request
    detectable            how large a fault must be to be found
"""
