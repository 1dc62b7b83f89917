MODULE CarryEgm$number
  ! $cell
  ! Robot $robot in task $task, UdpUc device CarryUc$number
  PERS tooldata carryPad := $tool;
  CONST jointtarget carryFirst := $first;
  CONST egm_minmax carryClose := [-0.001,0.001];
  VAR egmident carryEgm;

  PROC CarryEgm()
    CarryCheckStart;
    EGMReset carryEgm;
    EGMGetId carryEgm;
    EGMSetupUC ROB_$number, carryEgm, "default", "CarryUc$number" \Joint
      \CommTimeout:=1;
    EGMActJoint carryEgm \Tool:=carryPad $criteria
      \LpFilter:=0 \SampleRate:=4
      \MaxSpeedDeviation:=$deviation;
    ! For a day: a job that is held stands still for as long as it takes.
    EGMRunJoint carryEgm, EGM_STOP_HOLD $moved \CondTime:=86400;
    EGMReset carryEgm;
  ERROR
    IF ERRNO = ERR_UDPUC_COMM THEN
      TPWrite "Carry: run_egm.py is silent; the arm holds its place.";
      EXIT;
    ENDIF
  ENDPROC

  ! It does not move the arm there: nobody has checked such a move for collisions.
  PROC CarryCheckStart()
    VAR jointtarget here;
    here := CJointT();
    IF $away THEN
      TPWrite "Carry: jog the robot to carryFirst, pads away from the box.";
      ! After Stop, a press of Start would go on behind the check.
      EXIT;
    ENDIF
  ENDPROC
ENDMODULE
