"""Tables in the formats of loggers, oscilloscopes and spreadsheets, made from their manuals."""

from datetime import datetime, timedelta

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import choose, columns_of
from ou_monitor.recordings.importers.csv_table import holds_supply
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import CsvColumns, Request
from ou_monitor.recordings.read import read_recording, tidy
import pytest

N = 60
_RNG = np.random.default_rng(7)
K = np.arange(N)
U = np.round(0.3 + 0.2 * np.sin(K / 5.0), 3)
V = np.round(15.6 - 1.2 * U + 0.02 * _RNG.standard_normal(N), 3)
AMPS = np.round(2.0 + 30.0 * U, 2)
BEGIN = datetime(2024, 5, 16, 8, 2, 6)


def table(header, row, end='\n', more=''):
    """Return a table of the lines above, and of a row for each sample."""
    return end.join([*header, *(row(k) for k in range(N)), more])


def german(value):
    return f'{value}'.replace('.', ',')


def thousands(value):
    return f'{value:,.0f}'.replace(',', '.')


def clock(k, pattern='%Y-%m-%d %H:%M:%S.%f', step=0.01):
    return (BEGIN + timedelta(seconds=step * k)).strftime(pattern)


# Name -> content, time from row to row (s), whether throttle and current are in it.
FORMS = {
    'plain': (table(['time_s,voltage_v,throttle,current_a'],
                    lambda k: f'{0.01 * k:.2f},{V[k]},{U[k]},{AMPS[k]}'), 0.01, True, True),
    # A sketch's counts of its converter are not a current in A DC.
    'sketch': (table(['# Format:', 'Timestamp(ms),Voltage(V),Raw_ADC,Current_State'],
                      lambda k: f'{20 * k},{V[k]},{int(60 * V[k])},{k // 30}'), 0.02, False,
                False),
    # InfiniiVision: names, then units.
    'keysight': (table(['x-axis,1', 'second,Volt'],
                       lambda k: f'{1e-5 * (k - 30):.5E},{V[k]:+.4E}', '\r\n'), 1e-5, False,
                 False),
    # DS1000Z: rows are numbered, the step stands in the header.
    'rigol_ds': (table(['X,CH1,Start,Increment,', 'Sequence,Volt,-6.000000e-04,1.000000e-05,'],
                       lambda k: f'{k},{V[k]:.2e},,'.replace(f'{V[k]:.2e}', f'{V[k]:.4e}'),
                       '\r\n'), 1e-5, False, False),
    # MSO5000 without and with times.
    'rigol_mso': (table(['CH1V,t0 = -5.0e-04, tInc = 1.0e-05,'], lambda k: f'{V[k]:.4f},'), 1e-5,
                  False, False),
    # TDS1000: facts beside the first rows, no header.
    'tektronix_tds': ('\r\n'.join(
        f'{facts},{1e-5 * (k - 30):.11f},{V[k]:.5f},' for k, facts in enumerate(
            ['Record Length,2.500000e+03,', 'Sample Interval,1.000000e-05,',
             'Trigger Point,3.0000000e+01,', ',,', ',,', ',,', 'Source,CH1,', 'Vertical Units,V,',
             'Vertical Scale,2.0e+00,', 'Vertical Offset,0.0e+00,', 'Horizontal Units,s,',
             'Horizontal Scale,2.5e-03,', 'Pt Fmt,Y,', 'Yzero,0.0e+00,', 'Probe Atten,1.0e+01,',
             'Model Number,TDS1012B,', 'Serial Number,C0,', 'Firmware Version,FV:v22.11,',
             *[',,'] * (N - 18)])), 1e-5, False, False),
    'tektronix_mdo': (table(
        ['Model,MDO3024', 'Firmware Version,1.26', '', 'Waveform Type,ANALOG', 'Point Format,Y',
         'Horizontal Units,s', 'Horizontal Scale,4e-05', 'Sample Interval,1e-05',
         'Record Length,60', 'Probe Attenuation,10', 'Vertical Units,V,A', 'Label,,',
         'TIME,CH1,CH2'],
        lambda k: f'{1e-5 * k:.6e},{V[k]:.4f},{AMPS[k]}'), 1e-5, False, True),
    # A blank cell between the units; a line that has names and units at other cells.
    'tektronix_mso': (table(
        ['Model,MSO2014', 'Horizontal Units,S,,S', 'Vertical Units,V,,A', 'Label,,,',
         'TIME,CH1,CH2'], lambda k: f'{1e-5 * k:.6e},{V[k]:.4f},{AMPS[k]}'), 1e-5, False, True),
    'tektronix_5': (table(
        ['Model,MSO58,,Channel,CH1,,Channel,CH2', 'Horizontal Units,s,,,,,,',
         'Vertical Units,s,,Vertical Units,V,,Vertical Units,A', '', 'TIME,CH1,CH2'],
        lambda k: f'{1e-5 * k:.6e},{V[k]:.4f},{AMPS[k]}'), 1e-5, False, True),
    'siglent': (table(['Record Length,Analog:60', 'Sample Interval,CH1:1.00E-5', 'Vertical Units,'
                       'CH1:V', 'Model Number,SDS1104', 'Source,CH1', 'Second,Volt'],
                      lambda k: f'{1e-5 * k:.7f},{V[k]:.3f}'), 1e-5, False, False),
    # A fact with a decimal number above names that are units.
    'siglent_scale': (table(
        ['Record Length,Analog:60', 'Horizontal Scale, 0.500000000', 'Second,Volt'],
        lambda k: f'{1e-5 * k:.11f},{V[k]:.5f}'), 1e-5, False, False),
    'rohde': (table(['in s,CH1 in V'], lambda k: f'{1e-5 * k:.6E},{V[k]:.4E}'), 1e-5, False,
              False),
    'picoscope': (table(['Time,Channel A', '(ms),(mV)', ''],
                        lambda k: f'{0.01 * k:.8f},{1e3 * V[k]:.8f}'), 1e-5, False, False),
    'waveforms': (table(['#Digilent WaveForms Oscilloscope Acquisition', '#Sample rate: 100000Hz',
                         'Time (s),Channel 1 (V)'], lambda k: f'{1e-5 * k:.7f},{V[k]:.4f}'), 1e-5,
                  False, False),
    # Names and units in comments; names in several lines, of which some are blank or repeated.
    'commented_units': (table(['# Export of a meter', '#time,current,voltage,power', '#s,A,V,W'],
                              lambda k: f'{0.01 * k:.2f},{AMPS[k]},{V[k]},0'), 0.01, False, True),
    'names_above': (table([',battery,battery,rc', ',voltage,current,throttle', 'time,,,'],
                          lambda k: f'{clock(k)},{V[k]},{AMPS[k]},{U[k]}'), 0.01, True, True),
    'names_repeated': (table(['timestamp,Voltage,Current', 'Berlin (+02:00),Pack [279],Pack [279]',
                              ',V,A'], lambda k: f'{clock(k)},{V[k]},{AMPS[k]}'), 0.01, False,
                       True),
    # Each topic at stamps of its own.
    'plotjuggler': (table(
        ['__time,/battery_state/voltage,/battery_state/current,/throttle/data,/imu/x'],
        lambda k: f'{1.7e9 + 0.01 * k:.3f},{V[k]},{AMPS[k]},{U[k]},\n'
                  f'{1.7e9 + 0.01 * k + 0.004:.3f},,,,0.1'), 0.01, True, True),
    'excel_de': ('\ufeff' + table(['Zeit [s];Spannung [mV];Gas [%];Strom [A]'], lambda k: ';'.join(
        map(german, (round(0.01 * k, 3), round(1e3 * V[k]), round(100 * U[k], 1), AMPS[k]))),
        '\r\n'), 0.01, True, True),
    'excel_unicode': (('\ufeff' + table(['Zeit\tSpannung in V'], lambda k: '\t'.join(
        map(german, (clock(k, '%d.%m.%Y %H:%M:%S.') + f'{10 * k % 1000:03d}', V[k]))), '\r\n')
                       ).encode('utf-16-le'), 0.01, False, False),
    'blackbox_explorer': (table(
        ['"Product","Blackbox flight data recorder by Nicholas Sherlock"', '"minthrottle",1070',
         '"vbatcellvoltage","330,350,430"', '"looptime",125',
         '"loopIteration","time","axisP[0]","rcCommand[0]","rcCommand[3]","vbatLatest",'
         '"amperageLatest","motor[0]"'],
        lambda k: f'{k},{81000000 + 125 * k},-3,5,{1000 + 1000 * U[k]:.0f},{100 * V[k]:.1f},'
                  f'{100 * AMPS[k]:.0f},900'), 125e-6, True, True),
    'blackbox_decode': (table(
        ['loopIteration, time (us), axisP[0], rcCommand[3], vbatLatest (V), amperageLatest (A)'],
        lambda k: f'{k}, {5000 + 500 * k}, 1, {1000 + 1000 * U[k]:.0f}, {V[k]}, {AMPS[k]}'),
        500e-6, True, True),
    # Steps of 2 ms in us.
    'ardupilot': (table(['TimeUS\tRCOU.C1\tRCOU.C3\tVolt\tCurr'], lambda k: (
        f'{2000 * k}\t1500\t{1000 + 1000 * U[k]:.0f}\t{V[k]}\t{AMPS[k]}')), 0.002,
        True, True),
    'vesc_tool': (table(
        ['ms_today;input_voltage;temp_mos_max;temp_motor;current_motor;current_in;d_axis_current;'
         'erpm;duty_cycle;fault_code;d_axis_voltage;ms_today_setup;roll;'],
        lambda k: f'{41000000 + 20 * k};{V[k]};31.5;30.2;40.1;{AMPS[k]};0.1;3000;{U[k]};0;0.5;'
                  f'{41000000 + 20 * k};0.1;'), 0.02, True, True),
    'wheellog': (table(
        ['date,time,speed,voltage,phase_current,current,power,torque,pwm,battery_level,mode'],
        lambda k: f"{clock(k, '%Y-%m-%d,%H:%M:%S.')}{10 * k % 1000:03d},20.1,{V[k]},9.1,{AMPS[k]},"
                  f'700,0,{100 * U[k]:.1f},80,Drive'), 0.01, True, True),
    'ulog2csv': (table(
        ['timestamp,voltage_v,voltage_filtered_v,current_a,current_filtered_a,voltage_cell_v[0]'],
        lambda k: f'{112500000 + 10000 * k},{V[k]},{V[k]},{AMPS[k]},3,3.9'), 0.01, False, True),
    'rostopic': (table(['%time,field.header.seq,field.voltage,field.current'],
                       lambda k: f'{1700000000000000000 + 10000000 * k},{k},{V[k]},{AMPS[k]}'),
                 0.01, False, True),
    'arduino': (table(['millis;Ubat_mV'], lambda k: f'{4000 + 10 * k};{1e3 * V[k]:.0f}'), 0.01,
                False, False),
    # Names in a comment, between blanks whatever the delimiter; `u` is the throttle.
    'gnuplot': (table(['# time voltage current'],
                      lambda k: f'{0.01 * k:.2f}\t{V[k]}\t{AMPS[k]}'), 0.01, False, True),
    'numpy': (table(['# t [s] v [V] u throttle'], lambda k: (
        f'{0.01 * k:.18e} {V[k]:.18e} {U[k]:.18e} {U[k]:.18e}')), 0.01, True, False),
    # A time and one value without a telling name.
    'prometheus': (table(['"timestamp","value"'],
                         lambda k: f'{1715846526000 + 1000 * k},{V[k]}'), 1.0, False, False),
    'infiniium': (table(['Type:,raw', 'Points:,60', 'XInc:,1.0E-05', 'XOrg:,-2.0E-03',
                         'Y Units:,Volt', 'Data:,'], lambda k: f'{1e-5 * k:.11E},{V[k]:.6E}',
                        '\r\n'), 1e-5, False, False),
    'no_header': (table([], lambda k: f'{0.01 * k:.3f},{V[k]},', '\r\n'), 0.01, False, False),
    'edgetx_sticks': (table(['Date,Time,RxBt(V),Thr,TxBat(V)'],
                            lambda k: f"{clock(k, '%Y-%m-%d,%H:%M:%S.')}{10 * k % 1000:03d},"
                                      f'{V[k]},{2048 * U[k] - 1024:.0f},7.9'), 0.01, True, False),
    'cfclient': (table(['Timestamp,pm.vbat,stabilizer.thrust'],
                       lambda k: f'{12345 + 10 * k},{V[k]},{65535 * U[k]:.0f}.0'), 0.01, True,
                 False),
    'units_behind_numbers': (table(['"time","voltage","throttle"'], lambda k: (
        f'"{0.01 * k:.2f} s","{1e3 * V[k]:.0f} mV","{100 * U[k]:.1f}%"')), 0.01, True, False),
    'line_of_units': (table(['t\tU_batt\tthr\tI\tn\ttemp', '[ms]\t[V]\t[-]\t[A]\t[1/min]\t[K]'],
                            lambda k: f'{10 * k}\t{V[k]}\t{U[k]}\t{AMPS[k]}\t1\t300'), 0.01, True,
                      True),
    'thousands': (table(['Zeit [ms];Spannung [mV]'], lambda k: (
        f'{10 * k + 5000:,}.5;{1e3 * V[k]:,.1f}'.translate(str.maketrans(',.', '.,')))), 0.01,
                  False, False),
    'clock_by_its_cells': (table(['clock,battery voltage,# of flight'], lambda k: (
        f"{clock(k, '%H:%M:%S.')}{10 * k % 1000:03d},{V[k]},1")), 0.01, False, False),
    'fluke': (table(['Fluke 289', 'Reading;Sample;Start Time'], lambda k: (
        f"{k};{V[k]} VDC;{clock(k, '%m/%d/%Y %H:%M:%S.%f')}")), 0.01, False, False),
    'rcbenchmark': (table(['Time (s),ESC signal (µs),Thrust (kgf),Voltage (V),Current (A)'],
                          lambda k: f'{0.01 * k:.2f},{1000 + 1000 * U[k]:.0f},0.4,{V[k]},'
                                    f'{AMPS[k]}'), 0.01, True, True),
    'hioki': (table(['"File name","WAVE0001.CSV","V 1.00"', '"Title comment",""', '"Trigger Time",'
                     '"\'12-07-01 09:14:03"', '"Time","CH1[V]","Event"'],
                    lambda k: f'{0.01 * k:.9E},{V[k]:.5E},0'), 0.01, False, False),
    # Clocks in whole seconds beside a finer time, a unit in the next column, a line of units below
    # channels.
    'graphtec': (table(['Vendor ,"GRAPHTEC Corporation"', 'Sampling interval,10ms',
                        'Number,Date&Time,ms,CH1,CH2,Alarm1', 'NO.,Time,ms,V,A,A1234567890'],
                       lambda k: f"{k},{clock(k, '%Y/%m/%d %H:%M:%S')},{10 * k % 1000},"
                                 f'+{V[k]},+{AMPS[k]:7.2f},LLLLLLLLLL'), 0.01, False, True),
    # The unit at the end of each channel's line.
    'graphtec_amp': (table(['Sampling interval,100ms', 'AMP settings',
                            'CH,Signal name,Amp,Input,Range,Filter,Span,,Unit',
                            'CH3,U,M,DC,50V,Off,25,-25,V', 'CH4,I,M,DC,50mV,Off,20,-20,A', 'Data',
                            'Number,Date,Time,ms,CH3,CH4,Alarm'],
                           lambda k: f"{k + 1},{clock(k, '%Y/%m/%d,%H:%M:%S', 0.1)},"
                                     f'{100 * k % 1000},+{V[k]},+{AMPS[k]},LLLL'), 0.1, False,
                     True),
    'keithley': (table(['Model,DMM6500', '', 'Index,Reading,Unit,Range Digits,Date,Time,'
                        'Fractional Seconds,Relative Time,Channel'],
                       lambda k: f"{k + 1},{V[k]:.6E},Volt DC,5.5,{clock(k, '%m/%d/%Y')},"
                                 f"{clock(k, '%H:%M:%S')},0.01,{0.01 * k:.9f},"), 0.01, False,
                 False),
    'neware': (table(['Record ID,Realtime,Time(h:min:s.ms),Status,Current(mA),Voltage(mV)'],
                     lambda k: f"{k},{clock(k, '%Y-%m-%d %H:%M:%S')},00:00:{0.01 * k:06.3f},"
                               f'CC_DChg,{1e3 * AMPS[k]:.1f},{1e3 * V[k]:.0f}'), 0.01, False,
               True),
    'labview_lvm': (table(['LabVIEW Measurement', 'Separator\tTab', '***End_of_Header***',
                       'Delta_X\t0.01\t0.01', '***End_of_Header***\t\t\t',
                       'X_Value\tPack Voltage\tPack Current\tComment'],
                      lambda k: f'{0.01 * k:.6f}\t{V[k]}\t{AMPS[k]}\t'), 0.01, False, True),
    'asammdf': (table(['timestamps,BMS_PackVoltage,BMS_PackCurrent'],
                      lambda k: f'{0.01 * k:.2f},{V[k]},{AMPS[k]}'), 0.01, False, True),
    'odrive': (table(['time [s];axis0.motor.current_control.Iq_measured;vbus_voltage;ibus'],
                     lambda k: f'{0.01 * k:.2f};55;{V[k]};{AMPS[k]}'), 0.01, False, True),
    'mavlogdump': (table(
        ['timestamp,SYS_STATUS.load,SYS_STATUS.voltage_battery,SYS_STATUS.current_battery'],
        lambda k: f'{1.7e9 + 0.01 * k:.8f},325,{1e3 * V[k]:.0f},{100 * AMPS[k]:.0f}'), 0.01,
        False, True),
    'battery_status': (table(
        ['time_s,voltages[0],voltages[1],voltages[2],current_battery'],
        lambda k: f'{0.01 * k:.2f},{1e3 * V[k] - 8000:.0f},8000,65535,{100 * AMPS[k]:.0f}'), 0.01,
        False, True),
    # A unit behind each number, not always the column's.
    'grafana': (table(['Time,Battery voltage,Battery current'], lambda k: (
        f'"{clock(k)}","{V[k]} V","' + (f'{AMPS[k]} A"' if k % 3 else f'{1e3 * AMPS[k]:.0f} mA"'))
    ), 0.01, False, True),
    # Multiples of a unit, in a name and in brackets.
    'eagle_tree': (table(['Milliseconds,PackVolt*100,Amps*100,Throttle*100'], lambda k: (
        f'{10 * k},{100 * V[k]:.1f},{100 * AMPS[k]:.0f},{1e4 * U[k]:.0f}')), 0.01, True, True),
    'tattu': (table(['Time(10ms),Volt[cV],Current(10mA),Thr(0.1%)'], lambda k: (
        f'{k},{100 * V[k]:.1f},{100 * AMPS[k]:.0f},{1e3 * U[k]:.0f}')), 0.01, True, True),
    'uv': (table(['Time(ms),Pack(uV)'], lambda k: f'{10 * k},{1e6 * V[k]:.0f}'), 0.01, False,
           False),
    # A unit within a name.
    'benchvue': (table(['Name:,Load test,', 'Scan Interval:,0.01 s,', '', 'Scan Sweep Time (Sec),'
                        'Scan Number,101 (VDC)- Pack,121 (ADC)- Load'], lambda k: (
        f"{clock(k, '%m/%d/%Y %H:%M:%S.%f')},{k},{V[k]},{AMPS[k]}")), 0.01, False, True),
    # The mark of decimals separates the cells, too: numbers with decimals are quoted.
    'libreoffice_de': (table(['Zeit (s),Spannung (V),Strom (A),Gas'], lambda k: ','.join(
        f'"{german(x)}"' if x % 1.0 else f'{x:.0f}' for x in (0.01 * k, V[k], AMPS[k], U[k]))),
                       0.01, True, True),
    'airdata_sticks': (table(['time(millisecond),voltage(v),rc_throttle(percent)'], lambda k: (
        f'{10 * k},{V[k]},{200 * U[k] - 100:.1f}')), 0.01, True, False),
    # Each row names the series of its value.
    # Names are units.
    'sigrok': (table(['; CSV generated by libsigrok 0.5.2', '; Channels (2/2): V1, A1',
                      '; Samplerate: 100 Hz', 'milliseconds,V DC,A DC'],
                     lambda k: f'{10 * (k + 1)},{V[k]},{AMPS[k]}'), 0.01, False, True),
    # The column whose unit is known is the throttle.
    'airdata': (table(['time(millisecond),voltage(v),rc_throttle,rc_throttle(percent)'],
                      lambda k: f'{10 * k},{V[k]},{364 + 1320 * U[k]:.0f},{100 * U[k]:.1f}'),
                0.01, True, False),
    'datcon': (table(['Clock:offsetTime,RC:Throttle,Battery(0):current,Battery(0):totalVolts'],
                     lambda k: f'{0.01 * k:.3f},{2e4 * U[k] - 1e4:.0f},{AMPS[k]},{V[k]}'), 0.01,
               True, True),
    'bqstudio': (table(['Sample\tElapsedTime\tVoltage\tCurrent'], lambda k: (
        f'{k}\t{0.01 * k:.3f}\t{1e3 * V[k]:.0f}\t{1e3 * AMPS[k]:.0f}')), 0.01, False, True),
    'lecroy': (table(['LECROYWS3054,1,Waveform', '#1,26-Nov-2023 10:15:23,0', 'Time,Ampl'],
                     lambda k: f'{1e-5 * k:.6e},{V[k]}'), 1e-5, False, False),
    'matlab': (table(['Time,Voltage'], lambda k: clock(k, '%d-%b-%Y %H:%M:%S.%f') + f',{V[k]}'),
               0.01, False, False),
    # No names: of the columns beside the time, the first varies least.
    'serial_monitor': (table([], lambda k: clock(k, '%H:%M:%S.%f') + f' -> {V[k]}'),
                       0.01, False, False),
    'ros2_battery_state': (table([], lambda k: (
        f'{1700000000 + k // 40},{25000000 * (k % 40)},battery,{V[k]},nan,{AMPS[k]},'
        f'{5.2 - 1e-4 * k:.4f},nan,5.2,{1.0 - 2e-5 * k:.5f},2,1,3,True,'
        f'{V[k] / 4.0:.3f},3.9,3.9,3.9,,,')), 0.025, False, True),
    'metrawin': (table(['METRAwin 10', '', 'Datum;Zeit;Messwert;Einheit'], lambda k: (
        f"{clock(k, '%d.%m.%Y;%H:%M:%S,%f')};{german(V[k])};V DC")), 0.01, False, False),
    'minutes': (table(['Time (min),Voltage'], lambda k: f'{k / 6000:.9f},{V[k]}'), 0.01, False,
                False),
    # A number of days, as Excel exports a date without a format.
    'excel_days': (table(['Time,Voltage'], lambda k: f'{45428.335 + k / 8640000:.12f},{V[k]}'),
                   0.01, False, False),
    'pandas_timedelta': (table([',voltage'], lambda k: (
        f'{k // 30} days {23 * (k < 30):02d}:{59 * (k < 30):02d}:'
        f'{59.7 * (k < 30) + 0.01 * (k % 30):09.6f},{V[k]}')), 0.01, False, False),
    'rostopic_float': (table(['%time,field.data'], lambda k: (
        f'{1715846526000000000 + 10000000 * k},{V[k]}')), 0.01, False, False),
    # Rows are numbered; the name of the time has more words.
    'hoboware': (table(['"Plot Title: pack"', '"#","Date Time, GMT+02:00","Volt, V (LGR S/N: 1)",'
                        '"Host Connected (LGR S/N: 1)"'], lambda k: (
        f"{k + 1},{clock(k, '%m/%d/%y %I:%M:%S %p', 5.0)},{V[k]},")), 5.0, False, False),
    # Units below the names; a few are unknown.
    'megasquirt': (table(['"MS3"', 'Time\tRPM\tMAP\tBatt V\tAFR', 's\tRPM\tkPa\tV\tAFR'],
                         lambda k: f'{0.01 * k:.3f}\t2100\t45\t{V[k]}\t14.7'), 0.01, False,
                   False),
    # LVM: facts beside words and numbers above the rows, whose time is left blank.
    'labview_blank_time': (table([
        'LabVIEW Measurement', 'Writer_Version\t2', 'Reader_Version\t2', '***End_of_Header***', '',
        'Channels\t2', 'Samples\t60\t60', 'Date\t2024/05/16\t2024/05/16',
        'Time\t08:02:06,1\t08:02:06,1', 'Y_Unit_Label\tVolts\tAmps',
        'Delta_X\t0,001000\t0,001000', '***End_of_Header***',
        'X_Value\tVoltage\tCurrent\tComment'],
        lambda k: f'\t{german(V[k])}\t{german(AMPS[k])}', '\r\n'), 1e-3, False, True),
    # A meter that changes its range: the unit of each row.
    'autorange': (table(['Time,Value,Unit,Current,Current Unit'], lambda k: f'{0.1 * k:.1f},' + (
        f'{1e3 * V[k]:.0f},mV' if k % 7 == 3 else f'{V[k]},V DC') + (
            f',{AMPS[k]},A' if k % 5 else f',{1e3 * AMPS[k]:.0f},mA')), 0.1, False, True),
    # A fraction of the second in a column of its own.
    'keithley_parts': (table(['Date,Time,Fractional Seconds,Reading,Unit'], lambda k: (
        f"{clock(k, '%m/%d/%Y,%H:%M:%S', 2.5)},{(2.5 * k) % 1.0:.6f},{V[k]},V")), 2.5, False,
        False),
    # DJI: the stick from 364 to 1684.
    'phantomhelp': (table(['CUSTOM.date [local],CUSTOM.updateTime [local],RC.throttle,'
                           'BATTERY.voltage [V],BATTERY.current [A]'], lambda k: (
        f"{clock(k, '%m/%d/%Y,%I:%M:%S.%f %p', 0.1)},{364.0 + 1320.0 * U[k]:.2f},{V[k]},"
        f'{AMPS[k]}')), 0.1, True, True),
    # Castle: pulses in ms; EdgeTX: the pack beside the receiver.
    'castle': (table(['Seconds,Throttle (ms),Voltage (v),Current (A)'], lambda k: (
        f'{0.1 * k:.1f},{1.0 + U[k]:.3f},{V[k]},{AMPS[k]}')), 0.1, True, True),
    # GW Instek: facts end with a title.
    'gwinstek_title': (table(
        ['Format,1.0B', 'Source,CH1', 'Vertical Units,V', 'Sampling Period,4.000E-04',
         'Horizontal Old Scale,5.000E-03', 'Mode,Detail', 'Waveform Data'],
        lambda k: f'{4e-4 * k:.8E},{V[k]:.6f},'), 4e-4, False, False),
    # Facts, a blank line, names, units, a blank line.
    'motec': (table(
        [*(f'"{name}","fact",,' for name in 'Format Venue Vehicle Driver Device Comment'.split()),
         '"Log Date","28/11/2026",,', '"Log Time","10:38:24",,', '"Rate","50.000","Hz",', '', '',
         '"Time","Throttle Pos","Battery Voltage","Battery Current"', '"s","%","V","A"', '', ''],
        lambda k: f'"{0.02 * k:.3f}","{100 * U[k]:.1f}","{V[k]}","{AMPS[k]}"'), 0.02, True, True),
    # A line of sources below the line of units.
    'racechrono': (table(
        ['Format,3', '', 'timestamp,lap_number,elapsed_time,speed,battery_voltage,'
         'battery_current,throttle_pos', 'unix time,,s,m/s,V,A,%',
         ',,,100: gps,200: obd,200: obd,200: obd'],
        lambda k: f'{1.7e9 + 0.04 * k:.3f},1,{0.04 * k:.3f},0,{V[k]},{AMPS[k]},{100 * U[k]:.1f}'),
        0.04, True, True),
    # Text of Japanese Windows.
    'graphtec_jp': (table(['No.,測定開始', '番号,経過時間[s],電圧[V],電流[A]'],
                          lambda k: f'{k},{0.1 * k:.1f},{V[k]},{AMPS[k]}').encode('cp932'), 0.1,
                    False, True),
    # Names that are units; an analog input, of which the first is the voltage.
    'cycle_analyst': (table(['Time (s)\tAh\tV\tA\tS'], lambda k: (
        f'{k}\t{0.01 * k:.4f}\t{V[k]}\t{AMPS[k]}\t0.0')), 1.0, False, True),
    'labjack': (table(['Time\tAIN0\tAIN1'], lambda k: (
        f'{0.05 * k:.3f}\t{V[k]}\t0.01')), 0.05, False, False),
    # A row that numbers the columns, below it a blank line, or a time that leaps.
    'aim': (table(['"Time","External Voltage","Motor Current"', '"s","V","A"', '"1","2","3"', ''],
                  lambda k: f'"{0.05 * k:.3f}","{V[k]}","{AMPS[k]}"'), 0.05, False, True),
    'numbered_columns': (table(['Time,Voltage,Current', '1,2,3,'], lambda k: (
        f'{500 + 0.05 * k:.3f},{V[k]},{AMPS[k]},')), 0.05, False, True),
    # Narrow blanks between thousands.
    'excel_fr_thousands': (table(['Horodatage;Tension (mV);Intensité (mA)'], lambda k: (
        f"{clock(k, '%d/%m/%Y %H:%M:%S.%f', 0.1)};{1e3 * V[k]:,.1f};{1e3 * AMPS[k]:,.1f}"
    ).replace(',', '\u202f').replace('.', ',')), 0.1, False, True),
    # The time between rows by a prefix in another letter case, and by a clock.
    'owon': (table(['Sample Rate,10KSa/s', 'Frequency,?', 'index,CH1_Voltage(mV)'],
                   lambda k: f'{k},{1e3 * V[k]:.2f}'), 1e-4, False, False),
    'hantek': (table(['#CHANNEL:CH1', '#CLOCK=50.0uS', '#UNITS:V', ''],
                     lambda k: f'{V[k]:.5f},', '\r\n'), 5e-5, False, False),
    # Numbers HHMMSS.ss over a full minute.
    'racelogic': (table(['sats,time,velocity kmh,Battery_Voltage,Battery_Current'], lambda k: (
        f"012,{clock(k, '%H%M%S.00', 1.0)},41.0,{V[k]},{AMPS[k]}")), 1.0, False, True),
    # The unit of a row behind DC.
    'extech': (table(['Place\tDate\tTime\tCh1_Value\tCh1_Unit\tCh2_Value\tCh2_Unit\t'],
                     lambda k: f"{k}\t{clock(k, '%Y/%m/%d%t%H:%M:%S', 1.0)}\t{V[k]}\tDC V\t"
                               f'{AMPS[k]}\tDC A\t'), 1.0, False, True),
    # Each motor of PX4, the mean of which comes before the stick; the second stands still first.
    'plotjuggler_motors': (table(
        ['__time,battery_status/voltage_v,manual_control_setpoint/throttle,'
         'actuator_motors.00/control.00,actuator_motors.00/control.01'],
        lambda k: f'{0.01 * k:.2f},{V[k]},0.9,{2 * U[k] if k < 9 else U[k] - 0.05},'
                  f"{'nan' if k < 9 else U[k] + 0.05}"), 0.01, True, False),
    # The same times before each channel.
    'labview_multi': (table(['X_Value\tVoltage\tX_Value\tCurrent\tComment'], lambda k: (
        f'{0.01 * k:.2f}\t{V[k]}\t{0.01 * k:.2f}\t{AMPS[k]}')), 0.01, False, True),
    'excel_fr_gaz': (table(['Temps (s);Tension batterie (V);Commande gaz (%)'], lambda k: (
        f'{0.01 * k:.2f};{V[k]};{100 * U[k]:.1f}'.replace('.', ','))), 0.01, True, False),
    'scan_my_tesla': (table(['Time,Battery voltage,Accelerator Pedal'], lambda k: (
        f'{10 * k},{V[k]},{100 * U[k]:.1f}')), 0.01, True, False),
    'yokogawa_wt': (table(
        ['"Model Name","WT1800"', '', 'Store No.,Date,Time,Millisecond,U-1-Udc,I-1-Idc,P-1'],
        lambda k: f"{k},{clock(k, '%Y/%m/%d,%H:%M:%S', 0.1)},{100 * k % 1000},{V[k]},{AMPS[k]},1"),
        0.1, False, True),
    'power_meter': (table(['Store No.,Time,Urms-1,Irms-1,P-1'], lambda k: (
        f'{k},{0.1 * k:.1f},{V[k]},{AMPS[k]},43')), 0.1, False, True),
    'edgetx_vfas': (table(['Date,Time,RxBt(V),VFAS(V),Curr(A)'], lambda k: (
        f"{clock(k, '%Y-%m-%d,%H:%M:%S.%f', 0.1)},5.1,{V[k]},{AMPS[k]}")), 0.1, False, True),
    # Points between thousands, shown by the unit, the time or commas elsewhere.
    'excel_de_points': (table(['Zeit (ms);U_Akku (mV);PWM (µs)'], lambda k: ';'.join(map(
        thousands, (100 * k, 1e3 * V[k], 1e3 + 1e3 * U[k])))), 0.1, True, False),
    'excel_de_time': (table(['Zeit (ms);Akkuspannung'], lambda k: ';'.join(map(
        thousands, (100 * k, 1e3 * V[k])))), 0.1, False, False),
    'excel_de_both': (table(['Zeit (s);U_Akku (mV);Gas (%)'], lambda k: ';'.join(
        (german(round(0.1 * k, 1)), thousands(1e3 * V[k]), german(round(100 * U[k], 1))))), 0.1,
        True, False),
    # Another column has decimal points.
    'excel_de_mixed': (table(['Zeit (s);U (V);Gas;Lat'], lambda k: (
        f"{german(f'{0.1 * k:.3f}')};{german(f'{V[k]:.3f}')};{german(f'{U[k]:.3f}')};48.123456")),
        0.1, True, False),
    'excel_ch': (table(['Zeit (s);U_Akku (mV)'], lambda k: (
        f'{0.1 * k:.1f};' + thousands(1e3 * V[k]).replace('.', "'"))), 0.1, False, False),
    # Facts beside the first rows.
    'micsig': (table(['ProID,Info,,time,Vol.,'], lambda k: (
        f"{('Model,STO1104C', 'Record Length,4000', ',')[min(k, 2)]},,{0.1 * k:.1f},{V[k]},")),
        0.1, False, False),
    # A signal before the supply.
    'saleae_second': (table(['Time [s],Channel 0,Channel 1'], lambda k: (
        f'{0.1 * k:.1f},{3.3 * (k % 2):.3f},{V[k]}')), 0.1, False, False),
    # The lowest and the highest of each interval.
    'rohde_pairs': (table(['in s,C1 in V'], lambda k: (
        f'{0.1 * k:.6E},{V[k] + 0.1:.4E}\n{0.1 * k:.6E},{V[k]:.4E}')), 0.1, False, False),
    # A voltage with a current of its name is preferred.
    'two_packs': (table(['t,12V battery voltage,HV battery voltage,HV battery current'],
                        lambda k: f'{k},{5 + k % 2},{V[k]},{AMPS[k]}'), 1.0, False, True),
}


def written(tmp_path, content, name='export.csv'):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize('form', FORMS)
def test_an_export_is_read_without_an_option(form, tmp_path):
    """Time in s, voltage in V, throttle 0..1 and current in A, as they were made."""
    content, step, throttle, current = FORMS[form]
    path = written(tmp_path, content)
    found = read_recording(path)
    of_1970 = float(found.t[0] > 1e9)
    np.testing.assert_allclose(found.t - found.t[0], step * K, rtol=0.0,
                               atol=1e-3 * step + 1e-6 * of_1970)
    np.testing.assert_allclose(found.voltage, V, rtol=0.0, atol=6e-4)
    assert found.has_throttle == throttle
    if throttle:
        np.testing.assert_allclose(found.throttle, U, rtol=0.0, atol=6e-4)
    assert (found.current is not None) == current
    if current:
        np.testing.assert_allclose(found.current, AMPS, rtol=0.0, atol=6e-3)
    assert len({*found.source} - {'time_unit'}) == 3 + throttle + current
    said = [note for note in found.notes if note.startswith('Read time from')]
    assert len(said) == (form != 'plain')
    # Dates are not taken for a time in ms.
    assert not any('apart' in note for note in found.notes)
    # The bag that `convert` writes holds the same samples.
    log = import_log(path, Request())
    again = tidy(columns_of(path, log, choose(path, log)))
    np.testing.assert_allclose(again.voltage, found.voltage, rtol=2e-7)
    np.testing.assert_allclose(again.t, found.t, rtol=0.0, atol=1e-9 + 3e-7 * of_1970)


@pytest.mark.parametrize('content, columns, step, volts', [
    ('time,voltage\n0,12\n1,13\n2,14\n', CsvColumns(time_unit='ms'), 1e-3, [12, 13, 14]),
    ('time,voltage\n0,12000\n1,13000\n', CsvColumns(unit='V'), 1.0, [12000, 13000]),
    ('time_s,voltage_v\n0,12\n1,13\n', CsvColumns(sample_interval=0.25), 0.25, [12, 13]),
    ('12,5\n13,5\n13,7\n', CsvColumns(delimiter=';', decimal=',', sample_interval=0.1), 0.1,
     [12.5, 13.5, 13.7]),
    ('1 2 3\n4 5 6\nt U\n0 12\n1 13\n', CsvColumns(skip_rows=2, delimiter='space'), 1.0, [12, 13]),
    ('t|U\n0|12\n1|13\n', CsvColumns(delimiter='|'), 1.0, [12, 13]),
    ('t,V1,V2\n0,5,12\n1,5,13\n', CsvColumns(voltage='V2'), 1.0, [12, 13]),
    (' 0  12  0.1\n 1  13  0.2\n', CsvColumns(voltage='column 2'), 1.0, [12, 13]),
    # Minutes are not milli.
    ('Sampling interval: 1.5 min\nNo.,U\n0,12\n1,13\n', CsvColumns(), 90.0, [12, 13]),
    ('Sampling rate: 10 ms\nNo.,U\n0,12\n1,13\n', CsvColumns(), 0.01, [12, 13]),
    # HHMMSS over midnight.
    ('time,U\n235958,12\n235959,13\n0,14\n1,13\n', CsvColumns(), 1.0, [12, 13, 14, 13]),
    # Excel's mm:ss.0 drops the hours.
    ('Time,V\n59:59.0,12\n59:59.5,13\n00:00.0,14\n', CsvColumns(), 0.5, [12, 13, 14]),
    # A date and a clock are one time.
    ('Datum;Uhrzeit;U\n16.05.2024;23:59:59,5;12\n19.05.2024;00:00:00,5;13\n'
     '19.05.2024;00:00:02,0;14\n', CsvColumns(), [172801.0, 1.5], [12, 13, 14]),
    # Excel in German: dates and clocks keep their points, of which a number is in thousands.
    ('Zeit;U [mV]\n27.11.2026 10:15:23.125;24.674\n27.11.2026 10:15:23.250;1.024.673,5\n',
     CsvColumns(decimal=','), 0.125, [24.674, 1024.6735]),
    # A point elsewhere shows that quoted commas separate thousands.
    (table(['time_s,U (mV)'], lambda k: f'{k / 100},"12,{k:03}"'), CsvColumns(), 0.01,
     12.0 + 1e-3 * K),
    # Words of loggers for a missing number, and a factor in the unit of a column.
    ('time,VBAT (x10 mV)\n0,1200\n1,OL\n2,∞\n3,----\n4,--.--\n5,1.#QNAN\n6,-1.#IND\n7,1210\n',
     CsvColumns(), 7.0, [12.0, 12.1]),
    # UTF-16 without a mark of its byte order.
    (table(['Zeit;Spannung [V]'], lambda k: f'{german(k / 8)};{german(V[k])}').encode('utf-16-le'),
     CsvColumns(), 0.125, V),
])
def test_time_and_voltage_of_a_table(content, columns, step, volts, tmp_path):
    found = read_recording(written(tmp_path, content), columns=columns)
    np.testing.assert_allclose(found.voltage, volts)
    np.testing.assert_allclose(np.diff(found.t), step, rtol=1e-5)


@pytest.mark.parametrize('cells, given, volts, amps', [
    ('16108,986', None, 16.108, 9.86), ('16108,986', 'V', 16108.0, 986.0),
    # Unknown is no current of -10 mA, and no voltage of 65.5 V.
    ('16108,-1', None, 16.108, None), ('16108,0', 'mV', 16.108, 0.0),
    # A tool that has converted them keeps the names.
    ('16.108,9.86', None, 16.108, 9.86), ('16.108,9', None, 16.108, 9.0)])
def test_fields_of_mavlink_have_its_units(cells, given, volts, amps, tmp_path):
    """Millivolts and 10 mA, where the numbers are whole; a line says so, --unit V overrules it."""
    unknown = '' if '.' in cells else f'0.5,65535,{cells.split(",")[1]}\n'
    rows = ''.join(f'{k},{cells}\n' for k in range(1, 9))
    path = written(tmp_path, f'time_s,m.voltage_battery,m.current_battery\n{unknown}{rows}')
    found = read_recording(path, columns=CsvColumns(unit=given))
    voltage = found.voltage[found.t > 0.7]
    np.testing.assert_allclose(voltage, volts)
    assert found.n == 8 + (given == 'V' and bool(unknown))
    assert (found.current is None) == (amps is None)
    if amps is not None:
        np.testing.assert_allclose(found.current, amps)
    said = ' '.join(found.notes)
    assert ('mV by MAVLink' in said) == (given != 'V' and '.' not in cells)


def test_a_name_at_the_left_of_each_number_names_its_column(tmp_path):
    """As in dumps of MAVLink; the number of a column names it too.  A unit is no name."""
    path = written(tmp_path, table([], lambda k: (
        f'{clock(k)},FD, 0,sys_status_t,load,305,voltage_battery,{1e3 * V[k]:.0f},'
        f'current_battery,{1e2 * AMPS[k]:.0f},errors_count1,0,sig ,Len,43')))
    for columns in (None, CsvColumns(voltage='column 8', current='column 10')):
        found = read_recording(path, columns=columns)
        np.testing.assert_allclose(found.t - found.t[0], 0.01 * K, atol=1e-6)
        np.testing.assert_allclose(found.voltage, V)
        np.testing.assert_allclose(found.current, AMPS)
        assert found.source['current'] == 'current_battery'
    path = written(tmp_path, table([], lambda k: f'{k},mV,{V[k]},mA,{AMPS[k]}'))
    found = read_recording(path, columns=CsvColumns(voltage='column 3', current='column 5'))
    assert (found.source['voltage'], found.source['current']) == ('column 3', 'column 5')


def test_a_battery_state_without_a_header_keeps_the_sign_of_its_current(tmp_path):
    """Its charge, which rises here, is not taken for the time, nor its nanoseconds for stamps."""
    found = read_recording(written(tmp_path, table([], lambda k: (
        f'12,{2500000 * k},,{V[k]},nan,{-AMPS[k]},{5.0 + 1e-4 * k:.4f},nan,nan,0.9,2,1,3,False,,,'
    ))))
    np.testing.assert_allclose(found.t - found.t[0], 0.0025 * K, atol=1e-6)
    np.testing.assert_allclose(found.voltage, V)
    np.testing.assert_allclose(found.current, -AMPS)


@pytest.mark.parametrize('firmware, name, volts', [
    ('Betaflight 4.4.2', 'vbatLatest', 1580), ('Betaflight 3.5.7', 'vbatLatest', 158),
    ('INAV 7.1.2', 'vbat', 1580), ('INAV 7.1.2', 'vbat', 15.8)])
def test_the_explorer_of_blackboxes_writes_the_units_of_the_firmware(
        firmware, name, volts, tmp_path):
    """0.01 V, and 0.1 V before Betaflight 4.0; volts where a tool has converted them."""
    amps = 300 if volts > 100 else 3
    rows = ''.join(f'{k},{125 * k},{volts},{amps}\n' for k in range(9))
    found = read_recording(written(tmp_path, (
        f'"Firmware revision","{firmware} (0) F7"\n'
        f'"loopIteration","time","{name}","amperage"\n{rows}')))
    np.testing.assert_allclose(found.voltage, 15.8)
    np.testing.assert_allclose(found.current, 3.0)


@pytest.mark.parametrize('row', ['{},{},', '{},{}', ',{},{}'])
@pytest.mark.parametrize('end', ['', ','])
@pytest.mark.parametrize('first', [0, 5])
def test_a_label_before_the_names_is_not_the_name_of_the_first_column(row, end, first, tmp_path):
    """Facts above the rows hold a label and a cell of each channel; `CH1` is the first."""
    facts = ['Model Name,DLM2024', 'Version,1.60', 'Comment,', 'Block Number,1', 'History,1',
             'SampleRate,1E+03,1E+03', 'HOffset,0.0,0.0', 'Block Size,60,60', 'VUnit,V,A',
             'TraceName,CH1,CH2'][first:]
    path = written(tmp_path, table([*(f'{fact}{end}' for fact in facts), ''],
                                   lambda k: row.format(V[k], AMPS[k])))
    found = read_recording(path)
    np.testing.assert_allclose(found.voltage, V)
    np.testing.assert_allclose(found.current, AMPS)
    assert found.source['voltage'] == 'CH1'
    # A column that is only blank has its own name.
    path = written(tmp_path, table(['Version,1,2', 't,U,I'], lambda k: f'{k},{V[k]},'))
    np.testing.assert_allclose(read_recording(path).voltage, V)


def test_bytes_of_unknown_tables_do_not_stop_the_reading(tmp_path):
    """Old tables have bytes that Windows lacks, at the beginning or later; names may suffer."""
    path = written(tmp_path, table(['t [s],Batt\u00fc [V]'],
                                   lambda k: f'{k},{V[k]}').encode('cp437'))
    np.testing.assert_allclose(read_recording(path).voltage, V)
    rows = ''.join(f'{k},{V[k % N]},gr\u00fcn\n' for k in range(9000))
    path = written(tmp_path, f't,U,note\n{rows}'.encode('cp1252') + b'9000,12.0,\x81\n')
    assert read_recording(path).n == 9001
    path = written(tmp_path, f't,U,note\n{rows}'.encode('cp1252') + b'9000,12\x81,\n')
    with pytest.raises(InputError, match="9002: column 'U' holds '12"):
        read_recording(path)


@pytest.mark.parametrize('name, given, words', [
    ('I (A)', {'throttle': 'I (A)'}, r'a unit of current \(--current-column\):.*--throttle-unit'),
    ('P [W]', {'throttle': 'P [W]'}, "the unit 'w': name a column of throttle"),
    ('dt (s)', {'throttle': 'dt (s)'}, r'a unit of time \(--time-column\)'),
    ('soc (%)', {'voltage': 'soc (%)'}, 'a unit of throttle .* or give --unit'),
    ('Current(uA)', {'voltage': 'Current(uA)'}, 'a unit of current'),
    ('U2 [mV]', {'current': 'U2 [mV]'}, 'a unit of voltage .* name a column of current$')])
def test_a_named_column_of_another_quantity_is_refused(name, given, words, tmp_path):
    """Unless its unit or ends are given."""
    path = written(tmp_path, table([f'time_s,voltage_v,{name}'], lambda k: f'{k},{V[k]},{U[k]}'))
    with pytest.raises(InputError, match=words):
        read_recording(path, columns=CsvColumns(**given))
    if 'throttle' in given:
        found = read_recording(path, columns=CsvColumns(throttle_unit='0:0.5', **given))
        np.testing.assert_allclose(found.throttle, 2.0 * U)
    elif 'voltage' in given:
        found = read_recording(path, columns=CsvColumns(unit='V', **given))
        np.testing.assert_allclose(found.voltage, U)


@pytest.mark.parametrize('kind, words', [
    ('2', 'keep the rows of one$'), ('quad', 'keep those of one kind in a file of their own$')])
def test_lines_of_several_kinds_are_refused(kind, words, tmp_path):
    """Mission Planner: a name before each number; the lines of one message can be read."""
    status = [f'{clock(k)},FD,status,load,312,voltage_battery,{1e3 * V[k]:.0f},len,43\n'
              for k in K]
    hud = [f'{clock(k)},FD,vfr_hud,alt,12.{k},len,32\n' for k in K]
    beat = [f'{clock(k)},FD,heartbeat,type,{kind}\n' for k in K]
    with pytest.raises(InputError, match=words):
        read_recording(written(tmp_path, ''.join(map(''.join, zip(status, hud, beat)))))
    found = read_recording(written(tmp_path, ''.join(status)), columns=CsvColumns(
        voltage='column 7', unit='mV'))
    np.testing.assert_allclose(found.voltage, V, atol=6e-4)


def test_numbers_behind_labels_are_refused(tmp_path):
    """As for Arduino's serial plotter; beside a voltage, such a column is named as not read."""
    rows = ''.join(f'{0.01 * k:.2f},12.5,MODE:{k % 3}\n' for k in range(N))
    found = read_recording(written(tmp_path, f't,U,throttle\n{rows}'))
    assert not found.has_throttle and 'not read: throttle (text)' in found.notes[0]
    rows = ''.join(f'{clock(k)} -> Voltage:{V[k]},Current:3\n' for k in range(N))
    with pytest.raises(InputError, match="no column 'voltage_v'"):
        read_recording(written(tmp_path, rows))


@pytest.mark.parametrize('stamps, volts', [
    # Rows repeated; at an unsteady number, so that the value changes within a stamp.
    (np.arange(900) // 10, np.repeat(_RNG.normal(12.0, 0.1, 90), 10)),
    (np.cumsum(_RNG.random(900) < 0.1), np.repeat(_RNG.normal(12.0, 0.1, 90), 10))])
def test_other_rows_that_share_a_stamp_are_dropped(stamps, volts, tmp_path):
    path = written(tmp_path, 'time,U\n' + ''.join(
        f'{clock(int(k), "%H:%M:%S", 1.0)},{u:.3f}\n' for k, u in zip(stamps, volts)))
    found = read_recording(path)
    assert found.n == np.unique(stamps).size and 'dropped: repeated stamp' in found.notes[-1]
    assert any('--sample-interval' in note for note in found.notes)


@pytest.mark.parametrize('stamps', [np.arange(900) // 10, np.cumsum(_RNG.random(900) < 0.1)])
def test_stamps_too_coarse_for_the_voltage_are_refused(stamps, tmp_path):
    """A clock of whole seconds beside a voltage that changes at most rows, also by `convert`."""
    volts = _RNG.normal(12.0, 0.1, 900)
    path = written(tmp_path, 'time,U\n' + ''.join(
        f'{clock(int(k), "%H:%M:%S", 1.0)},{u:.3f}\n' for k, u in zip(stamps, volts)))
    for read in read_recording, lambda path: import_log(path, Request()):
        with pytest.raises(InputError, match='900 samples share .* stamps: .*--sample-interval'):
            read(path)
    given = CsvColumns(sample_interval=0.1)
    assert read_recording(path, columns=given).n == 900
    assert import_log(path, Request(columns=given)).series[0].n == 900


@pytest.mark.parametrize('first', ['high', 'low'])
def test_the_lower_of_two_rows_with_one_stamp_is_kept(first, tmp_path):
    """With its current; the last row has no partner; --sample-interval keeps all."""
    volts = np.append(np.repeat(V, 2), V[-1])
    volts[first == 'low':-1:2] += 0.3
    path = written(tmp_path, 't,U,I\n' + ''.join(
        f'{k // 2},{u:.3f},{10 * u:.2f}\n' for k, u in enumerate(volts)))
    found = read_recording(path)
    np.testing.assert_allclose(found.voltage, [*V, V[-1]])
    np.testing.assert_allclose(found.current, 10.0 * found.voltage)
    assert 'lower voltage' in found.notes[-1]
    assert read_recording(path, columns=CsvColumns(sample_interval=0.5)).n == 2 * N + 1


@pytest.mark.parametrize('header, row, words', [
    ('time_s,id,voltage', lambda k: f'{0.1 * k:.1f},{k % 2},{V[k] / (1 + k % 2)}',
     "named in 'id': 0, 1; if these are a load, give --throttle-column; else keep"),
    ('time_s,battery,voltage',
     lambda k: f"{0.1 * k:.1f},{('front', 'rear')[k % 2]},{V[k] / (1 + k % 2)}",
     "named in 'battery': front, rear; keep"),
    # Equal levels, at stamps in turn or equal.
    ('time_s,battery_id,voltage', lambda k: f'{0.1 * k:.1f},{k % 2},{V[k]}', "'battery_id': 0, 1"),
    ('time_s,id,voltage', lambda k: f'{0.1 * k:.1f},{k % 5 // 4},{V[k]}', "'id': 0, 1"),
    ('TimeUS,Inst,Volt', lambda k: f'{100000 * (k // 3)},{k % 3},{V[k]}', "'Inst': 0, 1, 2"),
    ('millis,A0,A1', lambda k: f'{40 * k},{50 * V[k]:.0f},{1e3 * U[k]:.0f}', 'A0.*convert counts'),
    ('ms,vbat', lambda k: f'{10 * k},{50 * V[k]:.0f}', 'no stated unit: .* give --unit V or mV')])
def test_several_series_and_counts_are_refused(header, row, words, tmp_path):
    path = written(tmp_path, table([header], row))
    with pytest.raises(InputError, match=words):
        read_recording(path)
    # A bag is not written either.
    with pytest.raises(InputError, match=words):
        import_log(path, Request())
    if ',id' in header:
        assert read_recording(path, columns=CsvColumns(throttle='id')).n == N
    elif 'vbat' in header:
        assert read_recording(path, columns=CsvColumns(unit='V')).n == N


@pytest.mark.parametrize('header, row, told', [
    # A load at random, or without an effect on the level, is no series.
    ('t [s],relay,U [V]', lambda k: f'{0.1 * k:.1f},{k * k % 7 % 2},{12.0 - k * k % 7 % 2}', 'V'),
    ('t [s],flag,U [V]', lambda k: f'{0.1 * k:.1f},{k % 2},{V[k]}', 'V'),
    # Decimals between semicolons, although three of them.
    ('t [s];U [V]', lambda k: f'{0.1 * k:.3f};{V[k]:.3f}', 'V'),
    ('time,voltage', lambda k: f'{0.1 * k:.1f},{V[k]}', 'V, a guess: --unit'),
    ('time,voltage', lambda k: f'{0.1 * k:.1f},{1e6 * V[k]:.0f}', 'uV, a guess: --unit'),
    ('time,CH1', lambda k: f'{0.1 * k:.1f},{V[k]}', 'V, a guess: --voltage-column and --unit')])
def test_the_unit_and_the_column_of_a_voltage_are_marked_if_guessed(header, row, told, tmp_path):
    found = read_recording(written(tmp_path, table([header], row)))
    assert f"' ({told})" in found.notes[0].split('voltage from')[1]
    assert 1.0 < np.median(found.voltage) < 20.0


@pytest.mark.parametrize('header', [
    't,throttle,temp', 't,throttle,rpm', 't,throttle,load1,load2', 't,level'])
def test_a_level_is_no_voltage_if_it_may_be_something_else(header, tmp_path):
    with pytest.raises(InputError, match="no column 'voltage_v'"):
        read_recording(written(tmp_path, table([header], lambda k: ','.join(
            map(str, (0.1 * k, U[k], V[k], V[k] + 1)[:header.count(',') + 1])))))


@pytest.mark.parametrize('name, cells, given, throttle', [
    ('gas', (1100, 1500, 1900), CsvColumns(), [0.1, 0.5, 0.9]),
    # An output is without pulses until it is armed.
    ('RCOut', (0, 1500, 1900), CsvColumns(), [0.0, 0.5, 0.9]),
    # The thrust of a Crazyflie may have decimals.
    ('gas', (0, 6553.5, 58981.5), CsvColumns(), [0.0, 0.1, 0.9]),
    ('gas', (1, 2, 1.5), CsvColumns(throttle_unit='%'), [0.01, 0.02, 0.015]),
    # Pulses in ms; a stick at rest; a duty below 0 runs a motor in reverse.
    ('Throttle', (1.1, 1.9), CsvColumns(), [0.1, 0.9]),
    ('Thr', (-1024, -1024), CsvColumns(), [0.0, 0.0]),
    ('duty [%]', (-50, 50), CsvColumns(), [-0.5, 0.5]),
    # The output of a lever, in V, is no percentage.
    ('gas', (0.9, 2.0, 4.1), CsvColumns(), 'throttle runs from 0.9 to 4.1'),
    ('gas', (1, 2, 1.5), CsvColumns(throttle_unit='us'),
     'not a pulse in us: half of its values are below')])
def test_the_unit_of_a_throttle(name, cells, given, throttle, tmp_path):
    path = written(tmp_path, f't,U,{name},I\n' + ''.join(
        f'{k},12,{cell},3\n' for k, cell in enumerate(cells)))
    if isinstance(throttle, str):
        with pytest.raises(InputError, match=throttle):
            read_recording(path, columns=given)
        return
    np.testing.assert_allclose(read_recording(path, columns=given).throttle, throttle)
    without = read_recording(path, columns=CsvColumns(throttle='none', current='none'))
    assert not without.has_throttle and without.current is None


@pytest.mark.parametrize('delimiter, decimal', [(',', '.'), ('\t', '.'), (';', ',')])
def test_a_known_mark_makes_the_other_one_separate_thousands(delimiter, decimal, tmp_path):
    """Integers in groups are ambiguous, unless decimals in groups show the mark, or --decimal."""
    quote, other = '"' * (delimiter == ','), '.,'.replace(decimal, '')
    rows = [f'{10 * k:,}|{12_000 + k:,}' for k in range(200)]
    for known, more in ((None, '.5'), (decimal, '')):
        path = written(tmp_path, '\n'.join([
            f'Time (ms){delimiter}U (mV)', *(f'{quote}{row}{more}{quote}'.translate(str.maketrans(
                {'.': decimal, ',': other, '|': f'{quote}{delimiter}{quote}'})) for row in rows)]))
        found = read_recording(path, columns=CsvColumns(decimal=known))
        assert found.t[-1] == pytest.approx(1.99)
        assert found.voltage[-1] == pytest.approx(12.199 + float(f'0{more}') / 1000)
    if quote:
        with pytest.raises(InputError, match='--'):
            read_recording(path)


@pytest.mark.parametrize('order', ['one after another', 'equal stamps', 'in turn'])
def test_several_series_in_one_column_are_refused(tmp_path, order):
    """Whatever column names them; the rows of one series can be read."""
    late = 0.5 if order == 'in turn' else 0.0
    rows = [(k + late * place, name, size + 0.1 * (k % 7))
            for place, (name, size) in enumerate((('pack/current', 3.0), ('pack/voltage', 12.0),
                                                  ('bus', 5.0)))
            for k in range(40)]
    if order != 'one after another':
        rows.sort()
    lines = ['time,topic,value', *(f'{t},{name},{value}' for t, name, value in rows)]
    path = written(tmp_path, '\n'.join(lines))
    for value, words in ((None, "no column 'voltage_v'"), ('value', (
            "'value' holds several series, named in 'topic': bus, pack/current, pack/voltage; "
            'keep the rows of one'))):
        with pytest.raises(InputError, match=words):
            read_recording(path, columns=CsvColumns(voltage=value))
    # The mode of a flight is no series, nor is a lone topic.
    for names in ('pack', 'arm', 'fly'), ('pack', 'pack', 'pack'):
        text = 'time,mode,value\n' + ''.join(
            f'{k},{names[k // 20]},{12.0 + 0.1 * (k % 7)}\n' for k in range(60))
        assert read_recording(written(tmp_path, text), columns=CsvColumns(voltage='value')).n == 60


def test_three_digits_behind_a_quoted_comma_may_be_thousands(tmp_path):
    """In a CSV with commas between cells; refused unless the decimal mark is given."""
    path = written(tmp_path, 't,U\n' + ''.join(f'{k},"16,52{k}"\n' for k in range(9)))
    with pytest.raises(InputError, match='decimal mark is a point .with --decimal'):
        read_recording(path, columns=CsvColumns(voltage='U'))
    found = read_recording(path, columns=CsvColumns(decimal=','))
    np.testing.assert_allclose(found.voltage, 16.52 + 1e-3 * np.arange(9))


def test_a_table_is_taken_for_a_supply_if_it_can_be_read(tmp_path):
    """Fleet takes what analyze reads: an oscilloscope's columns without names, too."""
    path = written(tmp_path, ''.join(
        f',,,{k / 50.0},{12.0 + 0.1 * (k % 7)}\n' for k in range(200)))
    assert read_recording(path).n == 200 and holds_supply(path)
    assert not holds_supply(written(tmp_path, 'name,text\na,b\nc,d\n', 'other.csv'))


def test_counts_of_unknown_size_and_mixed_units_are_refused(tmp_path):
    """0 to 10 000 is no known unit, unless its ends are given; a cell in mA is no voltage."""
    rows = 't,U,thr\n' + ''.join(f'{k},12 V,{100 * k}\n' for k in range(99))
    with pytest.raises(InputError, match='throttle runs from 0 to 9800'):
        read_recording(written(tmp_path, rows))
    found = read_recording(tmp_path / 'export.csv', columns=CsvColumns(throttle_unit='0:10000'))
    np.testing.assert_allclose(found.throttle, 0.01 * np.arange(99))
    with pytest.raises(InputError, match="holds '12 mA', not a number"):
        read_recording(written(tmp_path, rows.replace('9,12 V', '9,12 mA')))
    # A meter that is switched to amperes, late or between the first rows.
    volts = 'Time,Value,Unit\n' + ''.join(f'{k},12,V\n' for k in range(300))
    with pytest.raises(InputError, match="302: column 'Value' holds '3 A', not a number"):
        read_recording(written(tmp_path, volts + '300,3,A\n'))
    with pytest.raises(InputError, match="no column 'voltage_v'"):
        read_recording(written(tmp_path, 'Time,Value,Unit\n0,12,V\n1,3,A\n2,12,V\n'))


@pytest.mark.parametrize('header, row, words', [
    ('Time (s),Vfas,A1', lambda k: f'{0.1 * k:.1f},0.0,{V[k]}', "'Vfas' is 0 or blank"),
    ('Time(s),D0,A0,A1', lambda k: f'{0.1 * k:.1f},1,{k % 2},0', 'no voltage, only Time.s., D0'),
    ('Timestamp(ms),Current(uA),D0-D7', lambda k: f'{k},{U[k]},00000000', 'no voltage, only'),
    ('X_Value,Voltage,X_Value', lambda k: f'{k},{V[k]},{2 * k}', 'twice, .* --sample-interval'),
    ('', lambda k: f'{clock(k)},FE,attitude_t,roll,{k},pitch,2,yaw,3\n'
                   f'{clock(k)},1,sys_status_t,load,333,voltage_battery,16000',
     'messages of several kinds')])
def test_dead_sensors_and_logic_lines_are_no_voltage(header, row, words, tmp_path):
    """Nor does `convert` say less than `analyze`."""
    path = written(tmp_path, table([header], row))
    for read in read_recording, lambda path: import_log(path, Request()):
        with pytest.raises(InputError, match=words):
            read(path)


@pytest.mark.parametrize('unit, asked', [('ms', True), ('s', False)])
def test_a_step_far_below_its_unit_is_questioned(unit, asked, tmp_path):
    """Monsoon names ms, and writes s."""
    path = written(tmp_path, table([f'Time({unit}),Voltage'], lambda k: f'{2e-4 * k:.6f},{V[k]}'))
    assert ('2e-07 s from row to row: --time-unit s' in ' '.join(read_recording(path).notes)
            ) == asked
    assert read_recording(path, columns=CsvColumns(time_unit='s')).t[1] == 2e-4


def test_hours_between_samples_are_believed(tmp_path):
    """A unit that is stated, and coarse, is not questioned; nor is that of the user."""
    path = written(tmp_path, table(['Test Time / h,Voltage / V'], lambda k: f'{0.1 * k},{V[k]}'))
    assert np.median(np.diff(read_recording(path).t)) == pytest.approx(360.0)
    path = written(tmp_path, table(['time_s,voltage_v'], lambda k: f'{360 * k},{V[k]}'))
    with pytest.raises(InputError, match='360 s apart'):
        read_recording(path)
    assert read_recording(path, columns=CsvColumns(time_unit='s')).n == N
    for unit in ('ms', 'h'):
        path = written(tmp_path, table([f'Time ({unit}),voltage'], lambda k: f'{9000 * k},{V[k]}'))
        found = analyze(read_recording(path))
        assert not any('apart' in note for note in found.recording.notes) and not any(
            item.name == 'TIME_UNIT' for item in found.quality)


def test_a_late_line_does_not_change_the_time(tmp_path):
    """Another time that only rises is no reason to leave the one that is named best."""
    t = 0.1 * K
    t[[20, 21]] = t[[21, 20]]
    found = read_recording(written(tmp_path, table(
        ['time_s,voltage_v,charge_time_s'], lambda k: f'{t[k]:.1f},{V[k]},{2 * k}')))
    np.testing.assert_allclose(found.t, 0.1 * K)
    assert any('later stamp' in note for note in found.notes)


def test_a_time_with_decimals_is_finer_than_a_clock(tmp_path):
    """Arbin, once a second: dates are cut to whole seconds."""
    path = written(tmp_path, table(
        ['Data_Point,Test_Time(s),Date_Time,Step_Time(s),Voltage(V)'],
        lambda k: f'{k},{1.0 - 1e-4 + k:.5f},{clock(k, "%Y-%m-%d %H:%M:%S", 1.0)},0.5,{V[k]}'))
    np.testing.assert_allclose(read_recording(path).t, K + 1.0 - 1e-4)
    # Without a unit it may be in minutes.
    path = written(tmp_path, path.read_text().replace('Test_Time(s)', 'Test_Time'))
    assert read_recording(path).t[0] > 1e9


@pytest.mark.parametrize('names', ['', 't,source,command\n', 't,B1,pwm\n'])
def test_of_several_columns_without_telling_names_none_is_taken(names, tmp_path):
    """How steady a column is does not make it the voltage; the user can name it."""
    path = written(tmp_path, names + '\n'.join(f'{0.1 * k:.1f},{V[k]},{U[k]}' for k in range(N)))
    with pytest.raises(InputError, match="no column 'voltage_v'"):
        read_recording(path)
    place = names.split(',')[1] if names else 'column 2'
    found = read_recording(path, columns=CsvColumns(voltage=place))
    np.testing.assert_allclose(found.voltage, V)


@pytest.mark.parametrize('name', ['supply', 'Rail', 'Akku', 'U_Akku'])
def test_a_column_named_after_the_supply_is_its_voltage(name, tmp_path):
    path = written(tmp_path, table(
        [f't,{name},command'], lambda k: f'{0.1 * k:.1f},{V[k]},{U[k]}'))
    np.testing.assert_allclose(read_recording(path).voltage, V)


@pytest.mark.parametrize('pause, span', [(0, 0.059), (500000, 4294.9664)])
def test_a_counter_of_32_bits_goes_on(pause, span, tmp_path):
    """Unless the step there would be longer than others, as after a restart."""
    stamps = (2**32 - 10000 + 1000 * K + pause * (K > 9)) % 2**32
    path = written(tmp_path, table(['micros,vbat'], lambda k: f'{stamps[k]},{V[k]}'))
    t = read_recording(path).t
    assert t[-1] - t[0] == pytest.approx(span, rel=1e-3)


@pytest.mark.parametrize('header, row, words', [
    ('t,U,load', '{0},12,\n{0}.1,,{0}', 'load (--throttle-column or --current-column)'),
    ('t,U,throttle,gyro,rotor current', '{0},12,0.5,{0},{0}', 'rotor current (--current-column)'),
    # Another time is not offered.
    ('t,U,step time,x (s),load', '{0},12,{0},{0},{0}',
     'load (--throttle-column or --current-column)')])
def test_columns_that_may_be_throttle_or_current_are_named(header, row, words, tmp_path):
    """Though in rows of their own, or beside a throttle that was found; not if given as none."""
    path = written(tmp_path, '\n'.join([header, *map(row.format, range(9))]))
    assert f'not read: {words};' in read_recording(path).notes[0]
    notes = read_recording(path, columns=CsvColumns(throttle='none', current='none')).notes
    assert 'not read' not in notes[0]


def test_stacked_series_and_other_quantities_are_no_voltage(tmp_path):
    """A value beside names of series, or a temperature, is taken only if it is named."""
    for header, row in (('time,topic,value', '{},/bat,12.5'), ('time,temperature', '{},22.5')):
        content = '\n'.join([header, *(row.format(k) for k in range(N))])
        with pytest.raises(InputError, match="no column 'voltage_v'"):
            read_recording(written(tmp_path, content))


def test_one_column_is_one_series(tmp_path):
    path = written(tmp_path, 'time_s,x\n0,0.5\n1,0.6\n')
    with pytest.raises(InputError, match="'time_s' is the time, not a signal"):
        import_log(path, Request(names=frozenset(('time_s',))))
    log = import_log(path, Request(names=frozenset('x')))
    with pytest.raises(InputError, match='cannot be two of voltage, throttle and current: x, x'):
        choose(path, log, voltage='x', throttle='x')


def test_options_of_the_command_line(tmp_path, capsys):
    path = written(tmp_path, 'x;U\n' + ''.join(f'{k};12,{k % 9}\n' for k in range(300)), 'a.txt')
    given = ['--sample-interval', '0.01', '--delimiter', ';', '--decimal', ',', '--unit', 'mV']
    assert main(['analyze', str(path), *given, '--json', str(tmp_path / 'a.json')]) == 0
    assert "voltage from 'U' (mV)" in ' '.join(capsys.readouterr().out.split())
    for unit in ('dV', 'cV', 'uV'):
        assert main(['analyze', str(path), *given, '--unit', unit]) == 0
        assert f"voltage from 'U' ({unit})" in ' '.join(capsys.readouterr().out.split())
    assert main(['convert', str(path), str(tmp_path / 'bag'), *given]) == 0
    found = read_recording(tmp_path / 'bag')
    np.testing.assert_allclose(found.t, 0.01 * np.arange(300), atol=1e-9)
    np.testing.assert_allclose(found.voltage[:3], [0.012, 0.0121, 0.0122], rtol=1e-6)
    for wrong in (['--sample-interval', '0'], *(
            ['--throttle-unit', unit] for unit in ('1024', '5:5', 'a:b'))):
        assert main(['analyze', str(path), *wrong]) == 2


@pytest.mark.parametrize('content, words', [
    (b'PK\x03\x04' + bytes(50), 'workbook of Excel'), (b'<!DOCTYPE html><html>\n', 'a web page'),
    (b'<SALEAE>' + bytes(50), 'export it as CSV'), (b'SQLite format 3\0', 'ros2 bag convert'),
    (b'\x1f\x8b\x08\0' + bytes(50), 'gunzip'), (b'{"t": [0, 1]}\n', 'JSON'),
    (b'\x7fELF' + bytes(50), 'is not a table')])
def test_a_file_of_another_kind_is_named(content, words, tmp_path):
    """Whatever its name ends in; a log of an autopilot in a .csv is read as the log it is."""
    for name in ('a.csv', 'a'):
        if (name, words) == ('a', 'is not a table'):
            words = 'first bytes are'
        with pytest.raises(InputError, match=words):
            read_recording(written(tmp_path, content, name))


@pytest.mark.parametrize('content, words', [
    ('Zeit;U\n04.05.2024 10:00:00;12,5\nnoon;12,6\n', "'noon'"), ('t,U\n0,12\n1,1_5\n', "'1_5'"),
    ('date,U\n2024-13-01,12\n2024-13-02,12\n', 'month'),
    ('t,U\n0,12\n1,13\n'.encode('utf-16')[:-1], 'cut off in the middle of a character'),
    (b't,U\n0,12\n1,13\n' + bytes(4096), ':4: the line ends before'),
    ('date,U\n2024-01-01 33:00,12\n2024-01-02 33:00,12\n', 'hour'),
    ('time,U\n10:00:00,12\n10:00:99,12\n', "'10:00:99'"),
    ('time,U\n10:00:00,12\n10:99:00,12\n', "'10:99:00'"),
    ('time,U\n10:00:00,12\n10:00:01+99:99,12\n', r"'10:00:01\+99:99'"),
    # Decimal commas between commas; rows of an outer table, as battery testers write them.
    ('t,U\n0,000,12,500\n20,000,12,525\n', ':2: 4 cells, and the header names 2'),
    (table(['Cycle,Cap(Ah),Time', ',Step,Name,End(V),Time', ',,Record,Total Time,Voltage(V),Date'],
           lambda k: f'{k // 30},0.02,0.33\n,{k // 10},Rest,{V[k]},0:01:00\n' * (k % 10 == 0) + (
               f',,{k},0:00:{k:02},{V[k]},02/21/2020 10:32:{k:02}')),
     "4: the line ends before column 'Voltage")])
def test_cells_that_are_no_time_or_number_are_refused(content, words, tmp_path):
    with pytest.raises(InputError, match=words):
        read_recording(written(tmp_path, content))


def test_words_are_named_where_numbers_are_missing(tmp_path):
    """A throttle of words is named as not read; a table of words only has no numbers."""
    path = written(tmp_path, 'time_s,voltage_v,throttle\n' + ''.join(
        f'{k},{12 + k % 2},{"low high".split()[k % 2]}\n' for k in range(9)), 'a.csv')
    found = read_recording(path)
    assert not found.has_throttle and 'not read: throttle (text)' in ' '.join(found.notes)
    with pytest.raises(InputError, match='holds no numbers'):
        read_recording(written(tmp_path, 'name,city\nbob,paris\nann,rome\n', 'b.csv'))


@pytest.mark.parametrize('minute', [22, 10])
def test_a_time_with_dots_is_no_date(minute, tmp_path):
    """10.22.31 cannot be a date; 10.10.24 can, but alone it is no stamp of a sample."""
    times = [f'10.{minute + k // 60}.{k % 60:02}' for k in range(90 if minute > 12 else 31)]
    found = read_recording(written(tmp_path, 'Ora;Tensione\n' + ''.join(
        f'{time};12,{k % 7}\n' for k, time in enumerate(times))))
    np.testing.assert_allclose(found.t, 36000.0 + 60.0 * minute + np.arange(len(times)))
    days = ''.join(f'{k:02}.05.24;12,{k % 7}\n' for k in range(1, 20))
    found = read_recording(written(tmp_path, f'Datum;Spannung\n{days}'))
    np.testing.assert_allclose(np.diff(found.t), 86400.0)


@pytest.mark.parametrize('names', ['时间,电压,油门', '时间 (s),电压 (V),油门'])
def test_chinese_column_names_are_read(names, tmp_path):
    """Windows writes them as GBK, which no Western name resembles."""
    rows = ''.join(f'{k / 100},12.{k % 7},0.{k % 5}\n' for k in range(60))
    found = read_recording(written(tmp_path, f'{names}\n{rows}'.encode('gbk')))
    np.testing.assert_allclose(found.throttle, np.arange(60) % 5 / 10)
    assert 'gb18030' in found.notes[0] and '电压' in found.notes[0]
    other = written(tmp_path, f'Größe,Zeit (s),Spannung (V)\n{rows}'.encode('cp1252'))
    assert 'cp1252' in read_recording(other).notes[0]
