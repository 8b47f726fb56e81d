"""What labs use now, each as one script: scan, output folder, level -> mesh.ply, labels.nrrd, mass.json."""
