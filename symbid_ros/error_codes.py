"""Codes of errors, stable over releases, each with its cause and its fix.

The documentation lists them; tests bind to them rather than to the wording of a message.
"""

from typing import NamedTuple


class Entry(NamedTuple):
    """What a code means.

    Attributes
    ----------
    cause, fix : str
        One sentence each, for the documentation.
    """

    cause: str
    fix: str


CODES: dict[str, Entry] = {
    # E1xx: robot models
    "E101": Entry(
        "The model file cannot be read.",
        "Check the path and its permissions.",
    ),
    "E102": Entry(
        "The model exceeds a limit on bytes, elements, attributes, depth, bodies or joints.",
        "Reduce the model to the robot.",
    ),
    "E103": Entry(
        "The model file is not well-formed XML, or has a document type.",
        "Correct the file; remove <!DOCTYPE> and write entities out.",
    ),
    "E104": Entry(
        "The file is neither a URDF nor an MJCF, or is still xacro.",
        "Give a file with root <robot> or <mujoco>; run xacro first.",
    ),
    "E105": Entry(
        "A link, joint or frame has no name, or two have the same name.",
        "Name each one uniquely.",
    ),
    "E106": Entry(
        "The links of a URDF are not one tree.",
        "Connect all links to one root, with one parent each.",
    ),
    "E107": Entry(
        "A joint has a type that is not supported.",
        "Use revolute, continuous, prismatic and fixed joints.",
    ),
    "E108": Entry(
        "The model has an invalid, missing, infinite or excessive number.",
        "Correct the number on the line that the message names.",
    ),
    "E109": Entry(
        "A mimic joint follows itself or a joint that does not move.",
        "Name another joint, or remove <mimic>.",
    ),
    "E110": Entry(
        "An included file or mesh is outside the model's folder, or is included twice.",
        "Copy it into the folder and name it by a relative path; include it once.",
    ),
    "E111": Entry(
        "An MJCF loads plugins or other models, or generates bodies or meshes.",
        "Write bodies and inertias out, and remove the element.",
    ),
    "E112": Entry(
        "A mesh that determines a body's inertia is missing or has an unknown format.",
        "Supply the mesh, or give the body an <inertial>.",
    ),
    "E113": Entry(
        "MuJoCo cannot compile the MJCF.",
        "Correct what the message quotes from MuJoCo.",
    ),
    "E114": Entry(
        "No joint of the model moves, or more than one tree moves.",
        "Give the file of one robot with joints.",
    ),
    "E115": Entry(
        "The option `base` contradicts the free joint of an MJCF.",
        "Drop the option, or change the joint.",
    ),
    "E116": Entry(
        "The model has no frame or link of that name.",
        "Add it to the model, or remap header.frame_id.",
    ),
    "E117": Entry(
        "There is no joint term of that name.",
        "Choose from viscous, coulomb, armature and offset.",
    ),
    # E2xx: bags and messages
    "E201": Entry(
        "There is no bag at the given path.",
        "Give the folder of one recording or one of its .mcap or .db3 files.",
    ),
    "E202": Entry("No bag was given.", "Name at least one bag."),
    "E203": Entry(
        "A file that the bag's metadata.yaml lists is missing.",
        "Restore the file, or give the other files one by one.",
    ),
    "E204": Entry(
        "The file is not in MCAP or SQLite format, or is compressed as a whole.",
        "Convert or decompress it with the command that the message names.",
    ),
    "E205": Entry(
        "The recording was interrupted, so the file has no footer.",
        "Run `symbid bag recover` on it and use the new bag.",
    ),
    "E206": Entry(
        "The file is damaged.",
        "Use another copy, or run `symbid bag recover` on it and use the new bag.",
    ),
    "E207": Entry(
        "A size stated in the file exceeds its limit, as in a damaged or malicious file.",
        "Run `symbid bag recover` on it, or record in smaller chunks.",
    ),
    "E208": Entry(
        "The operating system cannot read the file.", "Check its permissions and the disk."
    ),
    "E209": Entry(
        "A metadata.yaml is not one that rosbag2 writes.",
        "Give the .mcap file instead of the folder.",
    ),
    "E210": Entry(
        "The bag or the ROS graph does not have the topic.", "Name one of the listed topics."
    ),
    "E211": Entry(
        "The topic has the wrong message type, or two types.",
        "Name another topic, or give bags of different recordings separately.",
    ),
    "E212": Entry(
        "There are several topics of joint states and none was chosen.",
        "Name the topic to use, or all topics whose joints are to be merged.",
    ),
    "E213": Entry(
        "The bag or one of its topics holds no message.",
        "Record it again, or leave the topic out.",
    ),
    "E214": Entry("A ground-truth topic was selected as a sensor.", "Name the topic of a sensor."),
    "E215": Entry(
        "The definition of a message type is missing or invalid.",
        "Source the workspace that defines it, or leave the topic out.",
    ),
    "E216": Entry(
        "A message is not a valid message of its topic's type.",
        "Check the publisher, leave the topic out, or use another copy of the bag.",
    ),
    "E217": Entry(
        "The encoding of a topic's messages or the type of a field is not supported.",
        "Leave the topic out, or record it in CDR.",
    ),
    "E218": Entry(
        "There is already something at the path of the new bag.",
        "Choose another name, or remove what is there.",
    ),
    "E219": Entry(
        "The operating system cannot create or write the bag.",
        "Free space on the disk, check the permissions, or choose another folder.",
    ),
    "E220": Entry(
        "A file of the bag was deleted or moved while the bag was being written.",
        "Record again, and leave the bag in place until the recording has ended.",
    ),
    "E221": Entry("Nothing in the damaged bag can be recovered.", "Use another copy of the bag."),
    "E222": Entry("A topic was added to a bag twice.", "Add each topic once."),
    "E223": Entry(
        "The ground-truth topics are missing or incomplete.",
        "Use a bag of this package's simulator with all three ground_truth/ topics.",
    ),
    "E230": Entry("A JointState message names a joint twice.", "Fix the driver."),
    "E231": Entry(
        "An IMU marks its angular velocity or linear acceleration as absent (covariance -1).",
        "Leave the topic out.",
    ),
    "E232": Entry(
        "No JointState message of the topic names its joints.",
        "Have the driver fill JointState.name.",
    ),
    "E233": Entry(
        "The header.frame_id of a sensor's messages changes.", "Give each sensor its own topic."
    ),
    "E234": Entry(
        "At least half of a sensor's messages hold NaN or infinite values.",
        "Fix the driver, or leave the topic out.",
    ),
    # E3xx: measurements
    "E301": Entry(
        "A topic has no usable message in the part of the log that is used.",
        "Check the topic's driver, use another part (--start, --stop), or leave the topic out.",
    ),
    "E302": Entry(
        "The topics, or the publishers of joint states, have no time in common.",
        "Synchronise the clocks that set header.stamp and record all topics together.",
    ),
    "E303": Entry(
        "The log is too short or has too many gaps.",
        "Record longer, repair the driver that drops messages, or publish at a higher rate.",
    ),
    "E304": Entry(
        "A joint has no finite position in at least half of the messages.",
        "Let its driver fill JointState.position, or give a model in which that joint is fixed.",
    ),
    "E305": Entry(
        "No joint of a robot with a fixed base has a measured effort.",
        "Let the driver fill JointState.effort.",
    ),
    "E306": Entry(
        "The log lacks joints of the model.",
        "Name every topic of joint states (--joint-topic, parameter joint_topic), or give the "
        "model of this robot.",
    ),
    "E307": Entry(
        "The base of the model floats, but no IMU was recorded.",
        "Record a sensor_msgs/msg/Imu topic, or give --base fixed if the base is bolted down.",
    ),
    "E308": Entry(
        "A sensor's frame is not in the model.",
        "Correct header.frame_id, add the frame to the model, or give --frame-prefix (parameter "
        "frame_prefix).",
    ),
    "E309": Entry(
        "header.frame_id of one topic changes during the log.",
        "Publish each sensor on a topic of its own.",
    ),
    "E310": Entry(
        "One of several publishers of joint states has fewer than two messages.",
        "Let it publish its joints at the rate of the others.",
    ),
    "E313": Entry(
        "A topic was silent during a part of the log or for a while live.",
        "Check its driver and clock, or leave that part out (--start, --stop).",
    ),
    "E314": Entry(
        "Header stamps jump back by more than a second, as when two runs are mixed.",
        "Give each run separately.",
    ),
    "E315": Entry(
        "All messages of a topic have the same header stamp.",
        "Let the driver fill header.stamp.",
    ),
    "E316": Entry(
        "The start and stop of the part of a log to use are invalid.",
        "Give a start of at least 0 and a later stop, in seconds after the first joint state.",
    ),
    "E317": Entry(
        "A smoothing filter has an invalid cutoff, window or degree.",
        "Give a cutoff of at least 0 Hz and below half the sampling rate, a positive window, and "
        "a degree of at least 2.",
    ),
    "E318": Entry(
        "The smoothing filter needs more samples than the log has without a gap.",
        "Raise the cutoff, shorten the filter's window, or record longer.",
    ),
    "E319": Entry(
        "The averaging windows hold too few samples at the rate of the joint states.",
        "Give a longer window, or record at a higher rate.",
    ),
    "E323": Entry(
        "A live message is not of this robot or holds a value that no sensor reads.",
        "Check the topic and its driver; the message is dropped and counted.",
    ),
    # E4xx: priors and estimates
    "E401": Entry(
        "The file of a prior, an estimate or information cannot be read.",
        "Check the path and its permissions.",
    ),
    "E402": Entry(
        "The file is not a prior.json.",
        "Write one with `symbid prior`.",
    ),
    "E403": Entry(
        "The prior belongs to another model.",
        "Draw a prior for this model with `symbid prior`.",
    ),
    "E404": Entry(
        "A value or standard deviation of the prior is not finite, or is outside a robot's range.",
        "Correct that entry of the prior.",
    ),
    "E405": Entry(
        "The prior's covariance factor is not that of its standard deviations.",
        "Give a lower triangular L with covariance L Lᵀ and a positive diagonal.",
    ),
    "E406": Entry(
        "The half-width of the prior is not positive, or leaves no mass.",
        "Give a positive half-width; below 100 % for a consistent prior.",
    ),
    "E407": Entry(
        "A link is physically inconsistent or its mass negative, so no prior is written.",
        "Correct the model, or choose another seed or a smaller half-width.",
    ),
    "E408": Entry(
        "The prior's covariance is singular.",
        "Give each parameter a positive standard deviation.",
    ),
    "E409": Entry(
        "The file is not an estimate.json, or has a value that is not finite.",
        "Write one with `symbid identify`.",
    ),
    "E410": Entry(
        "The file is not an information.npz.",
        "Give the file that `symbid identify` wrote.",
    ),
    "E411": Entry(
        "The information.npz has another format version or exceeds a limit.",
        "Identify the log again, or fewer logs at a time.",
    ),
    "E412": Entry(
        "Two sets of information differ in robot, columns or window.",
        "Combine runs with the same model, terms and window.",
    ),
    "E413": Entry(
        "A row of the equation of motion is not finite.",
        "Mask the samples with NaN or infinite values.",
    ),
    "E414": Entry(
        "A bound, weighing or left/right tie is invalid.",
        "Correct the values that the message names.",
    ),
    "E415": Entry(
        "No two links are mirror images of each other.",
        "Leave the left/right tie out.",
    ),
    "E416": Entry(
        "No physically consistent parameters satisfy the bounds.",
        "Loosen one of the bounds.",
    ),
    "E417": Entry(
        "A prior value or deviation is out of proportion, so accuracy was lost.",
        "Correct that entry of the prior.",
    ),
    "E418": Entry(
        "Data and prior together do not determine all parameters.",
        "Give each parameter a prior standard deviation.",
    ),
    "E419": Entry(
        "The base is fixed and no joint moves.",
        "Give a model with joints, or set `base` to floating.",
    ),
    "E420": Entry(
        "The log excites no parameter, or has too few samples.",
        "Record a longer log with more motion.",
    ),
    "E421": Entry(
        "The rank cannot be selected by centre of mass for a fixed base.",
        "Select it by torque or generalised force.",
    ),
    "E422": Entry(
        "Row weights cannot be computed from the sensors' noise.",
        "Give positive standard deviations, or weight by residuals.",
    ),
    "E423": Entry(
        "The posterior does not belong to the prior.",
        "Compare it with the prior that it was computed from.",
    ),
    # E5xx: options and their combinations, identification
    "E501": Entry(
        "An option has an invalid value, or there is no option of that name.",
        "Give a value of the type and range in the table of options.",
    ),
    "E502": Entry(
        "Two options contradict each other.",
        "Leave one of them out.",
    ),
    "E503": Entry(
        "An option has no effect or is not supported with the other options, or online.",
        "Leave it out, or choose the method or filter that the message names.",
    ),
    "E504": Entry(
        "The weighed mass contradicts the prior by more than six standard deviations.",
        "Check `total_mass` and the masses in the model or the prior.",
    ),
    "E505": Entry(
        "The information of another run has another robot, parameters, sensor errors or windows.",
        "Identify both logs with the same model and options.",
    ),
    "E506": Entry(
        "The information already includes seconds of this log, which would be counted twice.",
        "Leave `information` out, or identify another log.",
    ),
    "E507": Entry(
        "The method gives no covariance.",
        "Use `method` map or map_lmi.",
    ),
    "E508": Entry(
        "A log is too short to predict forces.",
        "Give a log that is longer than the windows and the settling of the filter.",
    ),
    "E509": Entry(
        "A table needs pandas, which is not installed.",
        "Run `pip install pandas`.",
    ),
    "E510": Entry(
        "No information was given to merge.",
        "Give the information of at least one log.",
    ),
    "E511": Entry(
        "An array has the wrong shape, or the motion of a floating base is missing.",
        "Give arrays of the shape that the message states.",
    ),
    "E512": Entry(
        "An estimate belongs to another robot than the model.",
        "Give the model that the estimate was identified with.",
    ),
    "E513": Entry(
        "The live wrenches do not carry the weight of the robot.",
        "Publish the wrench of every contact, check the model's masses, or set `unchecked`.",
    ),
    "E514": Entry(
        "The tare has no unloaded wrench sensor.",
        "Record the topics of the wrench sensors with nothing touching them.",
    ),
    "E515": Entry(
        "A wrench sensor of the tare has a NaN or infinite reading.",
        "Fix the driver and record the tare again.",
    ),
    "E516": Entry(
        "The validation log is too short for the windows of the training log.",
        "Give `validate` a longer log.",
    ),
    "E517": Entry(
        "The checks of `symbid bag doctor` call the log unusable.",
        "Fix the fault that the message names, or use the log as it is with `unchecked`.",
    ),
    "E518": Entry(
        "The instants of arrays are NaN, infinite or not in seconds.",
        "Give `time` in seconds, or as integers in nanoseconds.",
    ),
    "E519": Entry(
        "The log has no data in the requested part.",
        "Give an earlier `start`.",
    ),
    "E520": Entry(
        "A topic has no data in a part of the log where the others have.",
        "Leave the topic out, or check that all sensors use the same clock.",
    ),
    "E521": Entry(
        "No part of the log between two gaps is long enough for a window and its filter.",
        "Record longer, or choose a shorter `window`.",
    ),
    "E522": Entry(
        "Files of a result could not be written.",
        "Fix the cause in the message; results may be in the temporary folder that it names.",
    ),
    "E523": Entry(
        "A covariance does not belong to the parameters of the estimate.",
        "Identify the log again; keep the files of a result together.",
    ),
    "E524": Entry(
        "The base of the robot floats, but the bag has no IMU.",
        "Record the IMU, or set `base` to fixed if the base is bolted down.",
    ),
    "E525": Entry(
        "The ground truth has no stamp in common with the sensor data.",
        "Record ground truth and sensors together, and long enough for the filter to settle.",
    ),
    "E526": Entry(
        "A log of arrays was combined with the path of a bag, whose topics are unknown.",
        "Read the bag with `load_bag` and give the log instead of its path.",
    ),
    "E550": Entry(
        "A file of the installed package is missing.",
        "Install the package again, or source its setup.bash.",
    ),
    "E551": Entry(
        "The output exists already, or something else is in its place.",
        "Choose another --out, or give --overwrite to replace an earlier result.",
    ),
    "E552": Entry(
        "A file or folder cannot be written.", "Choose another place, or change its permissions."
    ),
    "E553": Entry(
        "A process that a command started failed or did not end.",
        "Read the log file that the message names.",
    ),
    "E554": Entry("All ROS domains of the machine are in use.", "Stop some of its nodes."),
    "E555": Entry(
        "`symbid prior` was given none or several of its kinds of priors.",
        "Give exactly one of --percent, --absolute and --consistent.",
    ),
    "E556": Entry(
        "A report was asked for something that it cannot show.",
        "Name folders of identifications, and add --truth for realistic predictions.",
    ),
    # E6xx: simulation
    "E601": Entry(
        "MuJoCo cannot compile the model file of the simulated robot.",
        "Correct the file at the place named in the message.",
    ),
    "E602": Entry(
        "The model file lacks a site, sensor, keyframe or joint that the simulator needs.",
        "Add the named element; config/symbitron.xml shows all of them.",
    ),
    "E603": Entry(
        "A noise or friction file cannot be read or is not valid YAML.",
        "Name an existing file and correct the named line.",
    ),
    "E604": Entry(
        "An entry of a noise or friction file is missing, unknown or not a valid number.",
        "Give each entry of config/noise.yaml or config/friction.yaml a finite number, 0 or more.",
    ),
    "E605": Entry(
        "A number of moves, seed, noise factor or payload time is out of range.",
        "Give at least one move, and finite numbers of 0 or more for the others.",
    ),
    "E606": Entry(
        "The scenario does not exist, or does not stand as a balance controller requires.",
        "Choose one of the scenarios in the message.",
    ),
    "E607": Entry(
        "The name of a systematic error is unknown.",
        "Give names from the message, separated by commas, or ``typical``.",
    ),
    "E608": Entry(
        "A payload has an invalid mass, position or radius.",
        "Give a positive mass, three coordinates and a radius of 0 or more, all finite.",
    ),
    "E609": Entry(
        "The robot has no link of the given name.",
        "Name a link of the model file.",
    ),
    "E610": Entry(
        "A link or the whole robot has no mass, hence no centre of mass to control.",
        "Give the controller inertias with mass.",
    ),
    "E611": Entry(
        "The simulator cannot apply the given torques.",
        "Create the simulator with ``is_commanded`` and give one finite torque for each drive.",
    ),
    "E612": Entry(
        "The simulated robot fell.",
        "Choose another motion seed, a lighter payload, or other torques if you command the robot.",
    ),
    "E613": Entry(
        "A joint of the simulated robot reached its end stop, whose force no sensor measures.",
        "Widen the joint's range in the model file or choose another motion seed.",
    ),
    "E614": Entry(
        "The balance controller found no torques that keep the robot standing.",
        "Choose another motion seed or raise the torque limits in the model file.",
    ),
    "E615": Entry(
        "The inertias of the controller's model give a mass matrix that is not positive definite.",
        "Give the controller physically possible inertias, such as those of ``map_lmi``.",
    ),
    "E616": Entry(
        "The address for UDP datagrams does not exist or is in use.",
        "Choose another host or port; 127.0.0.1 reaches programs on this machine alone.",
    ),
    "E617": Entry(
        "No measurement arrived from the simulator in time.",
        "Start the simulator at this host and port, or increase ``--timeout``.",
    ),
    "E618": Entry(
        "A UDP datagram does not follow the protocol.",
        "Send datagrams as in the documentation of the UDP loop; the message names the rule.",
    ),
    # E7xx: studies and reports
    "E701": Entry(
        "A study is not one of those that ship, or its file cannot be opened.",
        "Give the name of a study that ships, or the path of a .yaml file.",
    ),
    "E702": Entry(
        "The file of a study is not valid YAML, or an entry of it is unknown or invalid.",
        "Correct the entry that the message names; it suggests the most similar known name.",
    ),
    "E703": Entry(
        "The output folder of a study is a file, or holds files of something else.",
        "Give a new or empty folder as --out.",
    ),
    "E704": Entry(
        "The output folder holds results of another plan or of another version.",
        "Choose another folder as --out, or give --overwrite to replace the results.",
    ),
    "E705": Entry(
        "An intermediate file of a study is missing or damaged.",
        "Delete the file that the message names and start the study again.",
    ),
    "E706": Entry(
        "A process of a study was killed, perhaps for lack of memory.",
        "Start the study again to resume it, with fewer --workers.",
    ),
    "E707": Entry(
        "A table or figure needs a draw of the prior that the study does not have.",
        "Add the prior, filter and method to the plan.",
    ),
    "E708": Entry(
        "The chosen sensors leave no row of the equation of motion to identify from.",
        "Choose other sensors in the plan, or another robot or log.",
    ),
    "E709": Entry(
        "The data of a table or figure of a study are missing or do not match in size.",
        "Give one value for each parameter, link or run, and leave out what the study lacks.",
    ),
    "E750": Entry(
        "The estimates of one report have different parameters.",
        "Report on identifications of one robot with the same joint terms.",
    ),
    "E751": Entry(
        "The arrays of a report do not match in length or time.",
        "Give one value for each time, joint or link, and predict along one motion.",
    ),
    "E752": Entry(
        "The methods of a report have equal labels, or none of them is the chosen one.",
        "Give each method a label of its own and choose one with an estimate.",
    ),
    # E8xx: ROS nodes
    "E801": Entry(
        "A node parameter or launch argument is missing, invalid or contradicts another.",
        "Give the parameter that the message names a value of the type and range it states.",
    ),
    "E802": Entry(
        "A topic has a message type that is not installed on this machine.",
        "Install the package of the message type, or leave the topic out.",
    ),
    "E803": Entry(
        "A publishing rate does not divide the rate of the simulation.",
        "Give the rate of the simulation divided by a whole number.",
    ),
    "E804": Entry(
        "The start of a replay lies beyond the end of the bag.", "Give a smaller `start`."
    ),
    "E805": Entry(
        "No topic of the bag is left to replay.",
        "Name topics of the bag in `topics`, or fewer in `exclude`.",
    ),
    "E806": Entry(
        "A reliable subscriber has received nothing for a minute and blocks a lossless replay.",
        "Stop that subscriber, or set `rate` and `lossless:=false`.",
    ),
    "E807": Entry(
        "The recorder received no message.", "Check the names of the topics and `ROS_DOMAIN_ID`."
    ),
    "E808": Entry(
        "Writing a bag failed, and recorded messages are missing.",
        "Fix the disk problem that the message names and record again.",
    ),
    "E809": Entry(
        "A recorded message is too short for its type.",
        "Repair the bag with `symbid bag recover` and replay the result.",
    ),
    "E810": Entry(
        "The monitor received no estimate within its timeout.",
        "Check that the identifier runs, its name and `ROS_DOMAIN_ID`.",
    ),
    "E811": Entry(
        "The identifier stopped before its first estimate.",
        "Fix what the message names, such as a missing topic, and run longer.",
    ),
    "E812": Entry(
        "The identifier has not found its sensor topics yet.",
        "Start the robot's drivers, or correct the topic parameters.",
    ),
    "E813": Entry("The data so far are too few for an estimate.", "Wait, or let the robot move."),
    "E814": Entry(
        "Joint states lack a joint of the model, or a position or velocity.",
        "Publish all joints with positions and velocities, or choose another model.",
    ),
    "E815": Entry(
        "Feedback for the controller holds NaN, infinite or impossible values.",
        "Check the drivers of `joint_states` and `imu/data`.",
    ),
    "E816": Entry(
        "A command for the simulated robot is invalid and is ignored.",
        "Send commands as the page on ROS describes; it lists the reasons.",
    ),
    "E817": Entry(
        "The bytes of a message do not match its type.", "Check the publisher of the topic."
    ),
}
