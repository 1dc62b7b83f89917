MODULE Carry$number
  ! $cell
  ! Robot $robot in task $task
  ! $positions positions, $duration s
  PERS tasks carryTasks{2} := [["$first_task"],["$second_task"]];
  PERS tooldata carryPad := $tool;
  PERS loaddata carryHalfBox := $load;
$pressing  PERS wobjdata carryGrip := [FALSE,TRUE,"",$grip];
$pressing  ! 1 or -1: with which sign of Fz FCPress1LStart moves this pad along +z of
$pressing  ! carryPad. Find it out in the air, with 5 N; 0 ends the program.
$pressing  PERS num carrySign := 0;
$meetings
  CONST jointtarget carryFirst := $first;

  PROC Carry()
$pressing    IF Abs(carrySign) <> 1 THEN
$pressing      TPWrite "Carry: find out carrySign first, see the module.";
$pressing      EXIT;
$pressing    ENDIF
    CarryCheckStart;
    ConfL \Off;
$pressing    FCCalib carryPad.tload;
$calls
  ERROR
    IF ERRNO = ERR_WAITSYNCTASK THEN
      TPWrite "Carry: the other task did not come; this arm holds.";
      EXIT;
    ENDIF
  ENDPROC

$check
$phases
ENDMODULE
