"""Metrics of generated videos and scene states against ground truth: formulas on arrays.

Reading files, choosing frames and writing reports belong to `evaluation`.

    image             PSNR, SSIM, color drift, color fit
    lpips, dreamsim   perceptual distances by networks
    batches           frames in batches over the devices
    region            silhouettes, centroids and PSNR of hands and objects
    hands             keypoint error, IoU and recall of detected hands
    depth             depth error
    trajectory        camera errors
    alignment         best shift by whole pixels
    state_update      accuracy of a scene state after a move
    rank_correlation  Pearson, Spearman, MMRV
    loop              all measures of one simulator step
    rates             success of few trials: exact intervals, paired differences
    report            means, spreads, paired differences, printed tables
"""
