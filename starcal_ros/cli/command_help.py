# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Help of each command of the `starcal` tool: summary, description, examples."""

from __future__ import annotations

# Examples: a comment, then the line to type.
HELP: dict[str, str] = {
    'demo': """\
calibrate a small bag with the real ROS nodes

Starts the nodes, plays ten simulated images to them, requests a calibration through the service
and prints the result beside the truth.

  # write to the folder starcal_demo
  starcal demo
  # write to another folder
  starcal demo -o /tmp/first_look""",
    'init': """\
write the first parameter file of a bag or of photographs

Finds the camera by its stars and, where the bag has attitudes, how they are meant and the
alignment; writes params.yaml and camera.yaml, and lists what was found and what is left to state.

  # the bag in the repository, with nothing known
  starcal init bags/tiny -o first
  # photographs of the night sky
  starcal init 'night/*.jpg' -o first""",
    'inspect': """\
list the contents of a bag and the images a calibration would refuse

Lists topics, rates, stamps, encodings and gaps, and checks each image against the attitudes as a
calibration does. With --params the stars are measured as well.

  # check stamps and attitudes
  starcal inspect bags/tiny
  # also measure the stars, as "starcal calibrate" does
  starcal inspect bags/tiny --params bags/tiny/params.yaml
  # machine-readable output
  starcal inspect bags/tiny --json

exit status: 0 the bag can be calibrated; 3 it cannot, and the reasons are listed; 2 bad input.""",
    'diagnose': """\
find out why the images of a bag match no star

Identifies some of the first images without attitude or alignment, compares the attitudes,
alignment and camera with them, and prints the error, the evidence for it and the lines of the
parameter file that correct it.

  # no image matches: why?
  starcal diagnose bags/tiny --params bags/tiny/params.yaml
  # for a program
  starcal diagnose bags/tiny --params bags/tiny/params.yaml --json

exit status: 0 nothing is wrong; 3 a cause was found, or none could be; 2 bad input.""",
    'calibrate': """\
calibrate from bags, without a ROS graph

Measures the stars of all images, estimates camera and alignment, checks the result against the
limits of the gate and writes report.html, calibration.json, camera_info.yaml and
observations.mcap to DIR. Images without attitudes give the camera alone: their attitudes are
found from the stars.

  # the bag in the repository
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out
  # photographs of the night sky, and nothing else
  starcal calibrate 'night/*.jpg' -o out
  # the images of the first 30 s, and a comparison of its two halves
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out --to +30 --split-half
  # two bags together, with several cameras in them
  starcal calibrate night1 night2.mcap --params camera1.yaml -o out --image-topic /camera1/image
  # repeat from the recorded observations, with other options and without images
  starcal calibrate out/observations.mcap --params bags/tiny/params.yaml -o again""",
    'compare': """\
compare two calibrations in pixels and sigmas

A and B are each a calibration.json or a folder that holds one. Lines of sight are compared in the
star tracker frame, before and after removing their common rotation. Differences are B minus A;
their sigmas assume that A and B are independent.

  # two runs
  starcal compare out again
  # with the truth of a simulated bag
  starcal compare out sim/truth.json
  # with a map of the difference over the detector
  starcal compare out again -o difference.svg
  # machine-readable output
  starcal compare out/calibration.json again/calibration.json --json""",
    'plan': """\
say where to point the camera next

Estimates from the images so far, and chooses from the allowed pointings those whose stars lower a
sigma most, one after the other, with the sigma to expect after each.

  # the next ten images, anywhere on the sky
  starcal plan bags/tiny --params bags/tiny/params.yaml
  # five images, within 60 degrees of the zenith of Houston, away from the Sun
  starcal plan bags/tiny --params bags/tiny/params.yaml --images 5 \
      --within 250 30 60 --avoid 83 23 40 -o pointings.csv""",
    'report': """\
rewrite report.html of a calibration

Makes one page from the files of a folder: gate verdict, parameters, residuals, uncertainties,
refused images and stars. The page needs no network. --pdf writes the same as numbered pages with
a block for signatures (extra pdf).

  # from the files of an earlier calibration, with pages to sign
  starcal report out --pdf""",
    'lookup': """\
write a table of lines of sight and their sigma by pixel

Writes u_px, v_px, the unit vector x, y, z in the camera frame, shape_sigma_arcsec (1-sigma of the
direction, common rotation removed) and sigma_arcsec (in the star tracker frame), with the field
beside the lens model if there is one.

  # 25 x 25 pixels over the detector
  starcal lookup out -o lines_of_sight.csv
  # every 16 pixels, for interpolation
  starcal lookup out -o lines_of_sight.npz --step 16""",
    'play': """\
play a bag on the ROS graph

Publishes the messages of a bag with their own stamps, for the nodes to calibrate from.

  # in real time
  starcal play bags/tiny
  # as fast as the stars are observed
  starcal play bags/tiny --rate 0
  # on another topic
  starcal play bags/tiny --remap /opnav/image_raw:=/camera/image_raw""",
    'monitor': """\
show running nodes in the terminal

Shows images and refusals by reason, coverage, the forecast sigma of each parameter beside that of
the active calibration, the gate and the health of the nodes. Keys request a calibration, a dry
run, a roll-back or a reset.

  # live, until Ctrl-C
  starcal monitor
  # nodes in a namespace
  starcal monitor --remap __ns:=/cam1
  # one view after five seconds, for a log
  starcal monitor --once 5""",
    'request': """\
call a service of the running calibrator

Requests a calibration (calibrate, or solve with its options), the one before (rollback), an empty
ensemble (reset) or a table of lines of sight (lookup), and prints the answer. Exit status 3: the
calibrator declined.

  # calibrate from the images collected so far
  starcal request calibrate
  # the same without activating the result
  starcal request solve --dry-run
  # lines of sight of the active calibration of a calibrator in a namespace
  starcal request lookup -o sights.csv --remap __ns:=/cam1""",
    'simulate': """\
render a bag with known truth

Renders images of real stars with a simulated camera and writes the truth, a prior camera and a
parameter file beside the bag.

  # 24 images of 1296 x 1024, in a few seconds
  starcal simulate -o sim --scenario small
  # calibrate them
  starcal calibrate sim --params sim/params.yaml -o out
  # another draw of the camera and the noise
  starcal simulate -o sim2 --scenario small --seed 2
  # the camera of sim with other noise, twelve stars in each image
  starcal simulate -o sim3 --scenario small --seed 3 --camera-seed 1 --stars-per-image 12
  # a mistake to rehearse
  starcal simulate -o mirrored --scenario tiny --flip""",
    'campaign': """\
run a Monte Carlo study of the calibration

Calibrates many simulated campaigns and compares the estimates with the truth.

  # method against star tracker noise, as in Table 1 of the paper
  starcal campaign table1 -o studies
  # a shorter run: two noise levels, twenty trials
  starcal campaign table1 -o studies --trials 20 --tracker 0 20
  # the whole night of the paper from pixels, with its figures, in some minutes
  starcal campaign paper -o paper
  # twelve frames of it, in a minute
  starcal campaign paper -o paper --images 12 --trials 20""",
    'export': """\
write a calibration in the format of another tool

Writes SPICE kernels (FK and IK, or CK with the attitude of each image), an ALE fragment and ISIS
keywords, YAML of OpenCV, kalibr or ROS, arguments of GIANT, a model of mrcal, a table of lines of
sight, or C99 source; prints the parts that the format cannot hold and their cost in pixels. SPICE
kernels, tables and C hold everything.

  # frame and instrument kernel; the star tracker frame is defined too
  starcal export out --to spice -o kernels --spacecraft-id -999 --star-tracker-id -999100
  # with the frame names of the mission, whose frame kernel defines the star tracker
  starcal export out --to spice -o kernels --spacecraft-id -999 --star-tracker-frame MSN_ST1
  # attitude of the camera at each image, by its stars
  starcal export out --to ck -o kernels --spacecraft-id -999 --kernels naif.tls clock.tsc
  # for cv2.projectPoints
  starcal export out --to opencv -o opencv
  # C99 for flight software; later calibrations as tables that starcal_load checks
  starcal export out --to c -o src
  starcal export newer --to c --table -o uplink""",
    'import': """\
make a bag from images and attitudes in the formats of a mission

Images are FITS (tiled, scaled and floating point too), TIFF or PNG; attitudes, of several star
trackers too, CCSDS AEM, CSV, SPICE CK with SCLK and LSK, or the WCS that a program such as
astrometry.net wrote; velocities CCSDS OEM, CSV or SPK. Times of UTC, TAI, TT, TDB and GPS become
UTC. With --camera a parameter file to calibrate the bag is written beside it.

  # FITS and an attitude ephemeris
  starcal import --images 'night/*.fits' --attitude attitude.aem -o bag --camera prior.yaml
  # SPICE kernels for attitude and velocity
  starcal import --images 'night/*.fits' --attitude ck.bc clk.tsc lsk.tls --star-tracker ST1 -o bag
  # FITS solved by astrometry.net, which writes NAME.wcs beside NAME.fits
  starcal import --images 'night/*.fits' --attitude 'night/*.wcs' -o bag --camera prior.yaml
  # PNG with a table of times and one of attitudes
  starcal import --images 'night/*.png' --times times.csv --attitude attitude.csv -o bag""",
    'catalog': """\
make a deeper star catalog from a table of Gaia

Adds the stars of a table of Gaia DR3 to the bundled catalog, which ends at V = 9: for narrow
fields. The table is of the sky that is photographed, with source_id, ra, dec, pmra, pmdec,
parallax, phot_g_mean_mag and bp_rp, or their names in VizieR.

  # stars about one field, from the Gaia archive
  starcal catalog gaia.vot -o deep.npz""",
    'trend': """\
follow calibrations over years

Reads every calibration.json and state folder under ROOT, calibrates bags with --params, and
observations of older versions again, into a Parquet table that grows; writes trend.html: each
parameter, boresight and alignment over time, steps and drifts with p-values, and what a
recalibration would have changed.

  # all calibrations of a mission; run again, only what is new is computed
  starcal trend mission -o trend
  # a thousand bags on two processes
  starcal trend fleet -o trend --params camera.yaml --workers 2
  # on a Dask cluster that sees the same files
  starcal trend /data/fleet -o trend --params camera.yaml --scheduler tcp://host:8786""",
}
